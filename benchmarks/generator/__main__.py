"""``python -m benchmarks.generator``."""

from benchmarks.generator.command import main

if __name__ == "__main__":
    main()

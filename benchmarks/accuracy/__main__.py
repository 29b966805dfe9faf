"""``python -m benchmarks.accuracy``; see `benchmarks.accuracy.command`."""

if __name__ == "__main__":
    # Imported here so that the processes that measure, which load this module too, hold their method's libraries alone.
    import typer

    from benchmarks.accuracy.command import main

    typer.run(main)

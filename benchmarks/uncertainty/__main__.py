"""``python -m benchmarks.uncertainty``; see `benchmarks.uncertainty.command`."""

if __name__ == "__main__":
    import typer

    from benchmarks.uncertainty.command import main

    typer.run(main)

"""Whether uncertainty can be believed; see `benchmarks.uncertainty.command`."""

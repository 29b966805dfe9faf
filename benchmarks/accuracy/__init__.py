"""Accuracy, time and memory of the project beside what it competes with; see `benchmarks.accuracy.command`."""

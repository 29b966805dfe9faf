"""Many small trainings beside each other, measured into one table of results."""

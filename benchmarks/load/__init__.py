"""Load and faults: what the service sustains, and what it survives."""

"""Measurements on the machine at hand: time of a request, accuracy beside interpolation."""

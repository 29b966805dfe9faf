"""The shape model: occupancy decoder, flow prior, fitting, surfaces and uncertainty.

Knows nothing of HTTP, DICOM or of who is asking. Units are mm, world
coordinates are RAS unless a docstring says otherwise.
"""

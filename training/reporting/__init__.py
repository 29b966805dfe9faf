"""The tables and figure panels of the MorphoFlow paper, for any sweep."""

"""Is the generator any good: compactness, generalisation, specificity, density, and the speed of samples."""

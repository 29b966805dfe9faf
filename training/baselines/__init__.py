"""What the model is measured against: interpolation between slices, PCA of distance fields, the predecessor's fit.

- `interpolation`: signed distances, parallel slices;
- `contours`: ITK's morphological interpolation, slices along the voxel axes;
- `distance_modes`, `distance_fit`, `distance_choice`: principal modes of signed-distance fields, fitted to any planes;
- `predecessor`: the latent code of this project's decoder by 1200 steps of Adam (needs torch).
"""

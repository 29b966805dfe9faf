"""Colours of scalars, the same in the files of meshes and in what is told of them."""

#: From low to high (RGB): pale, orange, dark red; told apart in grey and by the colour-blind.
RAMP = ((255, 245, 235), (241, 105, 19), (127, 39, 4))
#: The same for scalars of both signs, from the most negative: blue, nearly white, dark orange.
SIGNED_RAMP = ((5, 48, 97), (67, 147, 195), (247, 247, 247), (241, 105, 19), (127, 39, 4))

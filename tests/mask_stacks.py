"""Ellipsoids of voxels, cut to some of their planes, as stacks; and the planes that are found on them."""

import numpy as np
from hypothesis import strategies as st

from model.geometry import Grid
from model.inference.observations import MaskStack, find_planes

SHAPE = (30, 34, 26)
semi_axes = st.tuples(*[st.floats(6.0, 11.0)] * 3)
centres = st.tuples(*[st.floats(12.5, 13.5)] * 3)


def ellipsoid(radii=(9.0, 11.0, 8.0), centre=(14.2, 16.7, 12.4), shape=SHAPE):
    offsets = (np.indices(shape).T - centre) / radii
    return (offsets**2).sum(axis=-1).T <= 1.0


def cut(solid, planes):
    """What is left of a solid on some (axis, index) planes."""
    drawn = np.zeros_like(solid)
    for axis, index in planes:
        np.moveaxis(drawn, axis, 0)[index] |= np.moveaxis(solid, axis, 0)[index]
    return drawn


def stack_of(foreground, spacing=(1.0, 1.0, 1.0), origin=(0.0, 0.0, 0.0), excluded=None, part="mask[0]"):
    affine = np.diag([*spacing, 1.0])
    affine[:3, 3] = origin
    none = np.zeros(foreground.shape, bool)
    return MaskStack(part, Grid(foreground.shape, affine), foreground, none if excluded is None else excluded)


def found(foreground, rule="auto", **kwargs):
    return [(p.axis, p.index) for p in find_planes([stack_of(foreground, **kwargs)], rule)]


def held(solid, axis):
    return np.flatnonzero(np.moveaxis(solid, axis, 0).any(axis=(1, 2)))

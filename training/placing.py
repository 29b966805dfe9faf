"""Where a mask's object lies in the world and how far it reaches; the mask must not be empty."""

import numpy as np
from jaxtyping import Bool, Float

from model.geometry import Grid


def inner_points(mask: Bool[np.ndarray, "i j k"], grid: Grid) -> Float[np.ndarray, "n 3"]:
    """Centres (world mm) of the object's voxels."""
    return grid.to_world(np.argwhere(mask).astype(float))


def centroid(mask: Bool[np.ndarray, "i j k"], grid: Grid) -> Float[np.ndarray, "3"]:
    """Mean of the object's voxels (world mm): the origin of its canonical frame."""
    return np.asarray(inner_points(mask, grid).mean(axis=0))


def reach(mask: Bool[np.ndarray, "i j k"], grid: Grid) -> Float[np.ndarray, "3"]:
    """How far voxel centres of the object lie from its centroid at most (mm along R, A, S)."""
    world = inner_points(mask, grid)
    return np.asarray(np.abs(world - world.mean(axis=0)).max(axis=0))


def reach_with_voxels(mask: Bool[np.ndarray, "i j k"], grid: Grid) -> Float[np.ndarray, "3"]:
    """The same with the voxels themselves, whichever way they lie."""
    return np.asarray(reach(mask, grid) + grid.spacing.max() / 2)

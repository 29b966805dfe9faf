"""How much of a reconstructed surface lies beyond everything that was drawn."""

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull

from model.inference.observations import Observations

#: Beyond is what lies outside the drawing's convex hull by more than this share of the object's length.
BEYOND_SHARE = 0.15
#: A surface with more than this share of its vertices beyond is called extrapolated. On validation shapes drawings of
#: the first third have 0.34 to 0.58; orthogonal, thin and thick ones and planes cut off at a quarter at most 0.09.
EXTRAPOLATED_SHARE = 0.25
#: Of a surface with more vertices than this, evenly spaced ones stand for all.
ENOUGH = 5000


def share_beyond(observations: Observations, vertices: Float[np.ndarray, "v 3"]) -> float:
    """Share of the vertices (world mm) that lie far outside the convex hull of the drawn foreground."""
    drawn = observations.points[(observations.labels > 0) & (observations.weights > 0)]
    if len(drawn) < 5 or not len(vertices):
        return 1.0
    some = vertices[:: -(-len(vertices) // ENOUGH)]
    # Joggled, since all points may lie in one plane.
    planes = ConvexHull(drawn, qhull_options="QJ").equations
    outside = np.max(some @ planes[:, :3].T + planes[:, 3], axis=1)
    return float(np.mean(outside > BEYOND_SHARE * _length(some)))


def coverage_warnings(observations: Observations, vertices: Float[np.ndarray, "v 3"]) -> tuple[str, ...]:
    """What to tell when the drawing covers too little of the object."""
    share = share_beyond(observations, vertices)
    if share <= EXTRAPOLATED_SHARE:
        return ()
    sentence = (
        f"About {100 * share:.0f} % of the surface lies far beyond everything that was drawn and rests on the "
        "population alone; do not rely on it there."
    )
    return (sentence,)


def _length(points: Float[np.ndarray, "v 3"]) -> float:
    """Extent (mm) along the longest principal axis."""
    centred = points - points.mean(axis=0)
    axes = np.linalg.eigh(centred.T @ centred)[1]
    return float(np.ptp(centred @ axes, axis=0).max())

"""The methods that are measured, and which drawings they can take."""

from enum import StrEnum

from benchmarks.accuracy.drawings import DrawingName


class MethodName(StrEnum):
    """Ways from a drawing to a dense mask."""

    PROJECT = "project"
    ALONE = "model-alone"
    ADAM = "adam"
    SIGNED_DISTANCE = "signed-distance"
    ITK = "itk"
    PCA = "pca"

    @property
    def label(self) -> str:
        """In tables."""
        return {
            MethodName.PROJECT: "MorphoFlow",
            MethodName.ALONE: "MorphoFlow, model alone",
            MethodName.ADAM: "predecessor (Adam, 1200 steps)",
            MethodName.SIGNED_DISTANCE: "signed distance",
            MethodName.ITK: "ITK contours",
            MethodName.PCA: "PCA of signed distances",
        }[self]


#: Methods that learn nothing.
INTERPOLATIONS = (MethodName.SIGNED_DISTANCE, MethodName.ITK)


def reason_against(method: MethodName, drawing: DrawingName) -> str:
    """Why a method cannot take a drawing; empty when it can."""
    if method is MethodName.SIGNED_DISTANCE and not drawing.parallel:
        return "takes parallel slices only"
    if method is MethodName.ITK and drawing.random:
        return "takes slices along the voxel axes only"
    return ""

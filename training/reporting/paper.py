"""What the MorphoFlow paper reports (its tables 1 and 2), on its own data: VerSe and OAI-ZIB.

Its femur cells "thick, without flow" at 16 and 32 dimensions repeat "thin, with flow" to the digit, and the ASD of
vertebra "thin, without flow" at 256 does not go with the HD95 beside it: these are marked as doubtful.
"""

from dataclasses import dataclass
from typing import Literal

Bone = Literal["vertebra", "femur"]
#: Means and SDs of ASD, HD95, HD (mm) and Dice.
Figures = tuple[tuple[float, float], tuple[float, float], tuple[float, float], tuple[float, float]]


@dataclass(frozen=True)
class PaperCell:
    """One half of a row.

    Attributes:
        figures: ASD, HD95, HD (mm) and Dice, mean and SD each.
        active: dimensions for 95, 97 and 99 % of the variance; none without flow and ARD.
        correlation: R^2 and Pearson's r of generated shapes; none without flow and ARD.
        doubtful: whether the cell contradicts others.
    """

    figures: Figures
    active: tuple[int, int, int] | None = None
    correlation: tuple[float, float] | None = None
    doubtful: bool = False


#: By bone, regime, latent size and whether there are flow and ARD.
PAPER: dict[tuple[Bone, str, int, bool], PaperCell] = {
    ("vertebra", "thin", 16, False): PaperCell(((0.86, 0.25), (3.41, 1.34), (9.86, 3.05), (0.87, 0.03))),
    ("vertebra", "thin", 16, True): PaperCell(
        ((0.84, 0.25), (3.41, 1.62), (9.96, 4.0), (0.87, 0.03)), (11, 12, 13), (0.76, 0.87)
    ),
    ("vertebra", "thin", 32, False): PaperCell(((0.69, 0.18), (2.75, 1.01), (8.62, 2.76), (0.89, 0.02))),
    ("vertebra", "thin", 32, True): PaperCell(
        ((0.72, 0.25), (3.04, 1.51), (9.16, 3.19), (0.89, 0.02)), (20, 21, 23), (0.72, 0.85)
    ),
    ("vertebra", "thin", 64, False): PaperCell(((0.57, 0.16), (2.38, 1.07), (8.05, 3.03), (0.91, 0.02))),
    ("vertebra", "thin", 64, True): PaperCell(
        ((0.6, 0.23), (2.64, 1.28), (8.53, 3.5), (0.9, 0.03)), (39, 44, 46), (0.79, 0.89)
    ),
    ("vertebra", "thin", 128, False): PaperCell(((0.49, 0.13), (2.15, 0.69), (7.78, 2.47), (0.92, 0.02))),
    ("vertebra", "thin", 128, True): PaperCell(
        ((0.55, 0.23), (2.57, 1.28), (8.49, 3.98), (0.91, 0.02)), (69, 79, 85), (0.33, 0.58)
    ),
    ("vertebra", "thin", 256, False): PaperCell(
        ((0.73, 0.11), (1.91, 0.55), (7.12, 2.22), (0.93, 0.01)), doubtful=True
    ),
    ("vertebra", "thin", 256, True): PaperCell(
        ((0.59, 0.27), (2.74, 1.52), (9.17, 3.78), (0.91, 0.03)), (164, 174, 183), (0.45, 0.67)
    ),
    ("vertebra", "thick", 16, False): PaperCell(((1.07, 0.24), (4.2, 1.51), (12.1, 3.37), (0.85, 0.03))),
    ("vertebra", "thick", 16, True): PaperCell(
        ((0.88, 0.26), (3.41, 1.58), (9.53, 3.7), (0.87, 0.03)), (11, 12, 13), (0.71, 0.84)
    ),
    ("vertebra", "thick", 32, False): PaperCell(((0.73, 0.15), (2.68, 0.78), (8.3, 2.41), (0.89, 0.02))),
    ("vertebra", "thick", 32, True): PaperCell(
        ((0.74, 0.19), (2.86, 1.0), (8.39, 2.98), (0.89, 0.02)), (20, 22, 24), (0.73, 0.85)
    ),
    ("vertebra", "thick", 64, False): PaperCell(((0.66, 0.15), (2.79, 1.09), (8.65, 3.07), (0.9, 0.02))),
    ("vertebra", "thick", 64, True): PaperCell(
        ((0.65, 0.25), (2.56, 1.12), (7.85, 2.85), (0.9, 0.03)), (38, 43, 46), (0.68, 0.82)
    ),
    ("vertebra", "thick", 128, False): PaperCell(((0.51, 0.1), (2.04, 0.59), (6.84, 2.24), (0.91, 0.01))),
    ("vertebra", "thick", 128, True): PaperCell(
        ((0.6, 0.19), (2.48, 1.11), (8.68, 4.09), (0.91, 0.02)), (73, 82, 89), (0.36, 0.65)
    ),
    ("vertebra", "thick", 256, False): PaperCell(((0.47, 0.09), (1.84, 0.41), (6.77, 1.98), (0.92, 0.01))),
    ("vertebra", "thick", 256, True): PaperCell(
        ((0.62, 0.24), (2.58, 1.28), (8.96, 3.5), (0.9, 0.03)), (164, 176, 185), (0.52, 0.72)
    ),
    ("femur", "thin", 16, False): PaperCell(((1.82, 0.47), (5.42, 1.4), (13.8, 3.83), (0.94, 0.01))),
    ("femur", "thin", 16, True): PaperCell(
        ((1.14, 0.25), (3.55, 0.82), (10.65, 3.64), (0.96, 0.01)), (11, 12, 13), (0.69, 0.83)
    ),
    ("femur", "thin", 32, False): PaperCell(((1.21, 0.27), (3.79, 0.89), (10.85, 3.02), (0.96, 0.01))),
    ("femur", "thin", 32, True): PaperCell(
        ((0.87, 0.19), (2.82, 0.65), (9.3, 3.08), (0.97, 0.0)), (20, 22, 24), (0.55, 0.74)
    ),
    ("femur", "thin", 64, False): PaperCell(((0.84, 0.17), (2.75, 0.6), (9.13, 3.26), (0.97, 0.0))),
    ("femur", "thin", 64, True): PaperCell(
        ((0.7, 0.15), (2.35, 0.55), (8.64, 2.87), (0.98, 0.0)), (39, 44, 47), (0.68, 0.82)
    ),
    ("femur", "thin", 128, False): PaperCell(((0.64, 0.12), (2.19, 0.46), (8.14, 2.53), (0.98, 0.0))),
    ("femur", "thin", 128, True): PaperCell(
        ((0.64, 0.26), (2.18, 0.91), (8.14, 2.95), (0.98, 0.01)), (76, 85, 91), (0.62, 0.79)
    ),
    ("femur", "thin", 256, False): PaperCell(((0.55, 0.1), (1.9, 0.42), (7.39, 2.56), (0.98, 0.0))),
    ("femur", "thin", 256, True): PaperCell(
        ((0.64, 0.35), (2.22, 1.09), (8.24, 3.19), (0.98, 0.01)), (163, 176, 186), (0.55, 0.74)
    ),
    ("femur", "thick", 16, False): PaperCell(((1.14, 0.25), (3.55, 0.82), (10.65, 3.64), (0.96, 0.01)), doubtful=True),
    ("femur", "thick", 16, True): PaperCell(
        ((1.12, 0.23), (3.49, 0.78), (10.24, 3.08), (0.96, 0.01)), (11, 12, 13), (0.71, 0.84)
    ),
    ("femur", "thick", 32, False): PaperCell(((0.87, 0.17), (2.82, 0.64), (9.3, 2.95), (0.97, 0.0)), doubtful=True),
    ("femur", "thick", 32, True): PaperCell(
        ((0.9, 0.19), (2.89, 0.64), (9.21, 2.93), (0.97, 0.0)), (20, 22, 24), (0.53, 0.73)
    ),
    ("femur", "thick", 64, False): PaperCell(((0.61, 0.14), (2.12, 0.54), (7.84, 2.51), (0.98, 0.0))),
    ("femur", "thick", 64, True): PaperCell(
        ((0.72, 0.15), (2.41, 0.53), (8.51, 2.59), (0.98, 0.0)), (40, 44, 48), (0.64, 0.8)
    ),
    ("femur", "thick", 128, False): PaperCell(((0.56, 0.13), (1.9, 0.46), (7.53, 2.32), (0.98, 0.0))),
    ("femur", "thick", 128, True): PaperCell(
        ((0.64, 0.26), (2.18, 0.75), (8.05, 2.57), (0.98, 0.01)), (75, 84, 91), (0.66, 0.817)
    ),
    ("femur", "thick", 256, False): PaperCell(((0.37, 0.11), (1.35, 0.43), (6.7, 2.31), (0.99, 0.0))),
    ("femur", "thick", 256, True): PaperCell(
        ((0.8, 0.61), (2.72, 2.09), (9.38, 5.38), (0.97, 0.02)), (166, 177, 186), (0.56, 0.75)
    ),
}


def bone_of(cohort: str) -> Bone | None:
    """Which of the paper's bones a cohort is, by its name."""
    name = cohort.lower()
    if "vertebra" in name or "verse" in name:
        return "vertebra"
    return "femur" if "femur" in name or "oai" in name else None


def paper_cell(cohort: str, regime: str, latent_size: int, flow_and_ard: bool) -> PaperCell | None:
    """The paper's cell for the same kind of bone, of another data set."""
    bone = bone_of(cohort)
    return None if bone is None else PAPER.get((bone, regime, latent_size, flow_and_ard))

"""Distal femurs from knee MR: the manual segmentations of OAI-ZIB.

    segmentation/segmentation_masks/9001104.segmentation_masks.mhd    MetaImage with its .raw or .zraw, or NIfTI

Labels are 1 femoral bone, 2 femoral cartilage, 3 tibial bone, 4 tibial cartilage. The name begins with the
participant's number in the Osteoarthritis Initiative, which is the person; left and right knees are mixed and not
marked. Every femur touches the face of the image where the shaft leaves it. A table ``cases.csv`` may name splits.
"""

import re
from collections.abc import Collection
from pathlib import Path

from model.errors import CohortError
from training.cohorts.assemble import CohortOptions, assemble
from training.cohorts.cohort import Cohort, Provenance, Refusal
from training.cohorts.folder import absent, merged, own_table, read_cases
from training.cohorts.reading import is_mask_file, stem

FEMUR = (1,)
PARTICIPANT = re.compile(r"\d{7}")
PROVENANCE = Provenance(
    source="OAI-ZIB, manual segmentations",
    licence="not stated",
    attribution="OAI-ZIB (Ambellan et al., Medical Image Analysis 52, 2019), Osteoarthritis Initiative",
    shippable=False,
)


def read_oai_zib(folder: Path, options: CohortOptions, *, labels: Collection[int] = ()) -> Cohort:
    """The femoral bones of a folder of masks, or what carries the labels that are named.

    Raises:
        CohortError: no mask whose name begins with a participant's number, or what `assemble` refuses.
    """
    files = sorted(path for path in folder.rglob("*") if is_mask_file(path) and PARTICIPANT.match(stem(path)))
    if not files:
        raise CohortError(
            "The folder holds no mask that is named after a participant (seven digits); those of OAI-ZIB are accepted."
        )
    known = {stem(path): {"person": path.name[:7]} for path in files}
    table = own_table(folder, persons=False)
    rows = merged(known, {name: table.get(name, table.get(row["person"], {})) for name, row in known.items()})
    cases, refused = read_cases(files, folder, rows, labels or FEMUR)
    refused += absent(table, (*known, *(row["person"] for row in known.values())))
    refused += [
        Refusal(path.name, "its name does not begin with a participant's number (seven digits)", stops=False)
        for path in sorted(folder.rglob("*"))
        if is_mask_file(path) and not PARTICIPANT.match(stem(path))
    ]
    return assemble("oai-zib", cases, refused, PROVENANCE, options, side="mixed")

"""Sides that drawings name by codes."""

import highdicom as hd
import numpy as np
import pytest
from pydicom import Dataset
from pydicom.sequence import Sequence as Items
from pydicom.sr.coding import Code

from service.adapters.dicom.laterality import SIDES, side_of
from tests.dicom_parts import mr_series, reread, rtstruct_of, seg_of

LEFT, RIGHT, BOTH = SIDES["L"], SIDES["R"], SIDES["B"]
SQUARE = np.array([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0], [9.0, 9.0, 0.0], [0.0, 9.0, 0.0]])


def coded(code):
    return Items([hd.sr.CodedConcept.from_code(code)])


def drawing(*sides, kind="SegmentedPropertyTypeCodeSequence", modifier="SegmentedPropertyTypeModifierCodeSequence"):
    """A segmentation with a segment of each side; None for a segment that names none."""
    volume = np.zeros((36, 30, 26, len(sides)), bool)
    volume[3:9, 3:9, 12] = True
    found = reread(seg_of(mr_series(), volume, labels=[f"segment {n}" for n in range(len(sides))]))
    for segment, side in zip(found.SegmentSequence, sides, strict=True):
        if side is not None:
            segment.setdefault(kind, coded(Code("5366008", "SCT", "Hippocampus")))
            setattr(segment[kind].value[0], modifier, coded(side))
    return reread(found)


@pytest.mark.parametrize(
    ("side", "letter"),
    [(LEFT, "L"), (RIGHT, "R"), (BOTH, "B"), (Code("G-A101", "SRT", "Left"), "L"), (Code("1", "SCT", "Upper"), "")],
)
def test_a_segment_names_its_side(side, letter):
    assert side_of(drawing(side)) == letter
    assert side_of(drawing(side), frozenset({1})) == letter


def test_the_modifier_of_a_region_counts_as_well():
    anatomic = {"kind": "AnatomicRegionSequence", "modifier": "AnatomicRegionModifierSequence"}
    assert side_of(drawing(RIGHT, **anatomic)) == "R"


def test_only_the_segments_that_are_meant_count():
    both = drawing(LEFT, RIGHT, None)
    assert [side_of(both, frozenset({number})) for number in (1, 2, 3)] == ["L", "R", ""]
    assert side_of(both) == ""
    assert side_of(drawing(LEFT, LEFT)) == "L"


def test_a_region_of_a_structure_set_names_its_side():
    images = mr_series()
    found = rtstruct_of(images, [("CLOSED_PLANAR", SQUARE + images[3].ImagePositionPatient)])
    assert side_of(reread(found)) == ""
    observation, code = Dataset(), hd.sr.CodedConcept.from_code(Code("5366008", "SCT", "Hippocampus"))
    code.SegmentedPropertyTypeModifierCodeSequence = coded(LEFT)
    observation.ObservationNumber, observation.ReferencedROINumber = 1, 1
    observation.RTROIIdentificationCodeSequence = Items([code])
    found.RTROIObservationsSequence = Items([observation])
    assert side_of(reread(found)) == "L"
    assert side_of(reread(found), frozenset({2})) == ""


def test_a_damaged_description_names_no_side():
    found = drawing(LEFT)
    found.SegmentSequence[0].SegmentNumber = None
    assert side_of(found, frozenset({1})) == ""
    assert side_of(Dataset()) == ""

"""Which objects go to which model, and which are left alone."""

import highdicom as hd
import numpy as np
import pytest
from pydicom import Dataset

from model.errors import InvalidMask, InvalidParameter
from service.adapters.dicom.masks import referenced_series
from service.adapters.pacs.configuration import Rule, load_configuration
from service.adapters.pacs.routing import MOST_STRUCTURES, find_rule
from tests.dicom_parts import mr_series, reread, ring, rtstruct_of, seg_of, two_boxes, with_region

SIZE = (12, 10, 8)


@pytest.fixture(scope="module")
def images():
    return mr_series(SIZE)


@pytest.fixture(scope="module")
def drawing(images):
    return reread(seg_of(images, two_boxes(SIZE), labels=("Left hippocampus", "tumour")))


def rule(**conditions) -> Rule:
    return Rule(name="r", model="hippocampus", fetch_from="a", send_to=("a",), **conditions)


@pytest.mark.parametrize(
    ("conditions", "structures"),
    [
        ({}, [{1}, {2}]),
        ({"segment_labels": ("*HIPPOCAMPUS",)}, [{1}]),
        ({"segment_labels": ("tum?ur", "none")}, [{2}]),
        ({"segment_codes": ("SCT:5366008",)}, [{1}, {2}]),
        ({"segment_codes": ("SCT:5366008",), "segment_labels": ("left*",), "senders": ("VIEWER",)}, [{1}]),
    ],
)
def test_conditions_that_hold(drawing, conditions, structures):
    match = find_rule([rule(**conditions)], drawing, "VIEWER")
    assert match is not None
    assert list(match.structures) == structures


@pytest.mark.parametrize(("conditions", "expected"), [({}, None), ({"segment_labels": ("hippo*",)}, {1})])
def test_a_drawing_of_one_structure_stays_whole(images, conditions, expected):
    drawn = np.zeros(SIZE, np.uint8)
    drawn[3:6, 3:6, 3:6] = 1
    match = find_rule([rule(**conditions)], reread(seg_of(images, drawn)), "VIEWER")
    assert match is not None
    assert match.structures == (expected,)


def test_segments_that_draw_nothing_are_no_structures(images):
    both = np.zeros((*SIZE, 2), np.uint8)
    both[7:9, 3:6, 3:6, 1] = 1
    found = reread(seg_of(images, both, labels=("left", "right")))
    match = find_rule([rule(segment_codes=("SCT:5366008",))], found, "VIEWER")
    assert match is not None
    assert match.structures == ({2},)


def test_the_background_of_a_label_map_is_no_structure(images):
    both = np.zeros((*SIZE, 2), np.uint8)
    both[3:6, 3:6, 3:6, 0] = both[7:9, 3:6, 3:6, 1] = 1
    found = reread(seg_of(images, both, "LABELMAP", labels=("left", "right")))
    match = find_rule([rule()], found, "VIEWER")
    assert match is not None
    assert match.structures == ({1}, {2})


def test_regions_are_structures_too(images):
    left, right, empty = (rtstruct_of(images, contours_at(images, places)) for places in ((2, 3), (4,), ()))
    found = with_region(with_region(left, right, 7), empty, 9)
    match = find_rule([rule(segment_labels=("hippo*",))], found, "VIEWER")
    assert match is not None
    assert match.structures == ({1}, {7})


def test_a_region_has_the_codes_of_all_observations_of_it(images):
    found = rtstruct_of(images, contours_at(images, (2, 3)))
    found.RTROIObservationsSequence = [observation(1, "5366008"), observation(2, "71341001"), observation(3)]
    for code in ("SCT:5366008", "SCT:71341001"):
        match = find_rule([rule(segment_codes=(code,))], reread(found), "VIEWER")
        assert match is not None
        assert match.structures == ({1},)
    assert find_rule([rule(segment_codes=("SCT:40238009",))], reread(found), "VIEWER") is None


def observation(number, code=None):
    found = Dataset()
    found.ObservationNumber, found.ReferencedROINumber = number, 1
    if code is not None:
        found.RTROIIdentificationCodeSequence = [hd.sr.CodedConcept(code, "SCT", "structure")]
    return found


def contours_at(images, places):
    return [("CLOSED_PLANAR", ring(images, place, (2.0,))[0]) for place in places]


def test_more_structures_than_anybody_draws_are_refused(images):
    found = rtstruct_of(images, contours_at(images, (3,)))
    one = reread(found)
    for number in range(2, MOST_STRUCTURES + 2):
        found = with_region(found, one, number)
    with pytest.raises(InvalidMask, match=f"{MOST_STRUCTURES + 1} segments or regions"):
        find_rule([rule()], found, "VIEWER")


@pytest.mark.parametrize(
    "conditions",
    [
        {"senders": ("OTHER",)},
        {"segment_labels": ("femur",)},
        {"segment_codes": ("SCT:71341001",)},
        {"body_parts": ("KNEE",)},
    ],
)
def test_conditions_that_do_not_hold(drawing, conditions):
    assert find_rule([rule(**conditions)], drawing, "VIEWER") is None


def test_the_first_rule_that_holds_takes_the_object(drawing):
    rules = [rule(senders=("OTHER",)), rule(mirror="auto"), rule()]
    match = find_rule(rules, drawing, "VIEWER")
    assert match is not None
    assert match.rule.mirror == "auto"


def test_images_and_own_results_are_left_alone(images, drawing):
    assert find_rule([rule()], images[0], "VIEWER") is None
    own = reread(drawing)
    own.Manufacturer = "MorphoFlow"
    assert find_rule([rule()], own, "VIEWER") is None


def test_regions_of_structure_sets_are_segments(images):
    found = rtstruct_of(images, [("CLOSED_PLANAR", ring(images, 3, (2.0,))[0])])
    match = find_rule([rule(segment_labels=("hippo*",))], found, "VIEWER")
    assert match is not None
    assert match.structures == ({1},)
    assert referenced_series(found) == images[0].SeriesInstanceUID


def test_the_images_are_those_that_were_drawn_on(images, drawing):
    assert referenced_series(drawing) == images[0].SeriesInstanceUID
    alone = reread(drawing)
    del alone.ReferencedSeriesSequence
    with pytest.raises(InvalidMask, match="no series"):
        referenced_series(alone)


GOOD = """
[listener]
calling_ae_titles = ["PACS"]
[[archives]]
name = "a"
dicomweb = "http://127.0.0.1:1/dicom-web"
[[rules]]
name = "one"
model = "hippocampus"
fetch_from = "a"
send_to = ["a"]
"""


def test_the_file_is_read(tmp_path):
    (tmp_path / "pacs.toml").write_text(GOOD)
    found = load_configuration(tmp_path / "pacs.toml")
    assert found.rule("one").send_to == ("a",)
    assert found.archive("a").dicomweb
    with pytest.raises(InvalidParameter):
        found.rule("gone")


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ('fetch_from = "a"', 'fetch_from = "b"', "file"),
        ('dicomweb = "http://127.0.0.1:1/dicom-web"', "", "archives.0"),
        ('model = "hippocampus"', 'modell = "hippocampus"', "rules.0.model"),
        ('["PACS"]', '["A TITLE THAT IS LONGER THAN SIXTEEN"]', "listener.calling_ae_titles.0"),
        ("[listener]", "[listener", "pacs_file"),
    ],
)
def test_slips_in_the_file_are_named(tmp_path, old, new, named):
    (tmp_path / "pacs.toml").write_text(GOOD.replace(old, new))
    with pytest.raises(InvalidParameter) as caught:
        load_configuration(tmp_path / "pacs.toml")
    assert caught.value.part == named

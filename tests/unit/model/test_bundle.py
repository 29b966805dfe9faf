import hashlib
import json
import shutil
from dataclasses import replace

import numpy as np
import onnx
import pytest

from model.bundle import (
    FORMAT,
    MANIFEST,
    POPULATION,
    REQUIRED_FILES,
    file_digest,
    open_bundle,
    plain_name,
    read_manifest,
    write_manifest,
)
from model.errors import BundleCorrupt, BundleError, BundleIncomplete, BundleTooNew, InvalidParameter
from tests.random_networks import DECODER, manifest_of

pytestmark = [
    pytest.mark.xdist_group("exported"),
    pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning"),
]


@pytest.fixture
def bundle(exported, tmp_path):
    return shutil.copytree(exported.folder, tmp_path / "secret_folder")


def edit(bundle, **values):
    path = bundle / MANIFEST
    path.write_text(json.dumps({**json.loads(path.read_text()), **values}))


def refusal(bundle, kind: type[BundleError], naming: str, backend="onnx") -> str:
    with pytest.raises(kind) as caught:
        open_bundle(bundle, backend=backend)
    sentence = str(caught.value)
    assert naming in sentence
    assert "secret_folder" not in sentence
    assert "/" not in sentence
    assert sentence.endswith(".")
    assert "\n" not in sentence
    return sentence


@pytest.mark.parametrize("backend", ["onnx", "torchscript"])
def test_an_untouched_bundle_opens(bundle, backend):
    model = open_bundle(bundle, backend=backend, threads=1)
    assert model.manifest.name == "random"
    assert model.population.codes.shape == (5, 3)
    np.testing.assert_array_equal(model.population.base_codes, 2 * model.population.codes)
    logits = model.decoder.logits(np.zeros((2, 3)), DECODER.extent_mm * np.ones((2, 4, 3)))
    assert logits.shape == (2, 4)
    assert model.prior.from_base(np.zeros((2, 3))).shape == (2, 3)


def test_the_digest_is_the_hash_of_the_manifest_and_changes_with_any_file(bundle):
    expected = hashlib.sha256((bundle / MANIFEST).read_bytes()).hexdigest()
    assert open_bundle(bundle).digest == read_manifest(bundle)[1] == expected
    with (bundle / POPULATION).open("ab") as stream:
        stream.write(b" ")
    files = [path.name for path in bundle.iterdir() if path.name != MANIFEST]
    write_manifest(manifest_of(bundle, files), bundle)
    assert read_manifest(bundle)[1] != expected


def test_writing_undoes_reading(bundle, tmp_path):
    manifest, digest = read_manifest(bundle)
    write_manifest(manifest, tmp_path)
    assert read_manifest(tmp_path) == (manifest, digest)
    assert manifest == manifest_of(bundle, list(manifest.files))


@pytest.mark.parametrize("part", ["name", "version"])
@pytest.mark.parametrize("text", ["My Bone", "a/b@c", "", ".hidden", "bone\n", "öl"])
def test_a_name_that_no_address_could_hold_is_refused(bundle, part, text):
    edit(bundle, **{part: text})
    with pytest.raises(BundleCorrupt, match="letters from A to Z"):
        read_manifest(bundle)
    edit(bundle, **{part: "Bone-2.1_a+b"})
    manifest, _ = read_manifest(bundle)
    with pytest.raises(InvalidParameter, match=f"The {part} .* letters from A to Z") as caught:
        write_manifest(replace(manifest, **{part: text}), bundle)
    assert caught.value.part == part


@pytest.mark.parametrize(
    ("text", "name"), [("hippocampus", "hippocampus"), ("My Bones (2)", "my-bones-2"), (" ", "model")]
)
def test_a_folder_gives_its_name_to_a_model_as_far_as_it_can(text, name):
    assert plain_name(text) == name


def test_a_later_format_is_refused(bundle):
    edit(bundle, format=FORMAT + 1)
    assert f"up to {FORMAT}" in refusal(bundle, BundleTooNew, f"format {FORMAT + 1}")


def test_what_a_manifest_says_beyond_this_format_is_passed_over(bundle):
    edit(bundle, colour="blue")
    assert open_bundle(bundle).manifest.name == "random"


@pytest.mark.parametrize("name", [POPULATION, "decoder_logits.onnx", "prior_sampling_1.onnx", "decoder_logits.pt"])
def test_a_missing_file_is_named(bundle, name):
    (bundle / name).unlink()
    refusal(bundle, BundleIncomplete, name)


@pytest.mark.parametrize("name", [POPULATION, "decoder_logits.onnx", "prior_sampling_1.onnx", "decoder_logits.pt"])
def test_a_file_with_one_other_bit_is_named(bundle, name):
    data = bytearray((bundle / name).read_bytes())
    data[len(data) // 2] ^= 1
    (bundle / name).write_bytes(data)
    refusal(bundle, BundleCorrupt, name)


def test_a_folder_without_a_manifest_is_refused(bundle):
    (bundle / MANIFEST).unlink()
    refusal(bundle, BundleIncomplete, MANIFEST)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b"[]",
        b"3",
        b'"text"',
        b"null",
        b"\xff\xfe\xfa",
        b"\x89PNG",
        b"{}",
        b'{"format": null}',
        b'{"format": "one"}',
        b'{"format": Infinity}',
        b"[" * 100_000,
        b'{"format": 1}',
    ],
)
def test_an_unparsable_manifest_is_refused(bundle, content):
    (bundle / MANIFEST).write_bytes(content)
    refusal(bundle, BundleCorrupt, MANIFEST)


@pytest.mark.parametrize("name", ["licence", "latent_size", "sigmas", "files"])
def test_what_a_manifest_lacks_is_named(bundle, name):
    values = json.loads((bundle / MANIFEST).read_text())
    del values[name]
    (bundle / MANIFEST).write_text(json.dumps(values))
    refusal(bundle, BundleCorrupt, f"lacks {name}")


@pytest.mark.parametrize(
    ("name", "value", "naming"),
    [
        ("frame", "LPS", "RAS is accepted"),
        ("units", "cm", "mm is accepted"),
        ("side", "north", "left, right, mixed, unpaired are accepted"),
        ("latent_size", 0, "from 1"),
        ("latent_size", 4, "sigmas"),
        ("sigmas", [1.0, 2.0], "sigmas of the manifest are 2"),
        ("sigmas", [1.0, 2.0, -3.0], "positive numbers"),
        ("sigmas", [1.0, 2.0, None], "positive numbers"),
        ("half_extent_mm", [10.0, 10.0], "three positive numbers"),
        ("resolution_mm", 0, "a positive number"),
        ("resolution_mm", True, "a positive number"),
        ("structure", None, "a text is accepted"),
        ("licence", 5, "a text is accepted"),
        ("training", [1], "an object is accepted"),
        ("calibration", "x", "an object is accepted"),
        ("anatomy", {"value": "1"}, "value, scheme and meaning"),
        ("likelihood_precision", None, "a positive number"),
        ("likelihood_precision", "0.1", "a positive number"),
        ("likelihood_precision", float("nan"), "a positive number"),
        ("active_dimensions", [1, 2], "three whole numbers"),
        ("active_dimensions", [1, 2, 2.5], "three whole numbers"),
        ("active_dimensions", "123", "three whole numbers"),
        ("accuracy", 3, "finite numbers by regime"),
        ("accuracy", {"thin": 0.9}, "finite numbers by regime"),
        ("accuracy", {"thin": {"dice": None}}, "finite numbers by regime"),
        ("accuracy", {"thin": {"asd_mm": float("inf")}}, "finite numbers by regime"),
        ("completion", [1], "a number from 0 to 1"),
        ("completion", {"share": "0.5"}, "a number from 0 to 1"),
        ("completion", {"share": 1.5}, "a number from 0 to 1"),
        ("completion", {"share": float("nan")}, "a number from 0 to 1"),
        ("discrepancy", {"spread_mm": 0.6}, "a number for fidelity"),
        ("usual", {"misfit_mm": 0.6, "misfit_exponent": 0.1}, "surface_sd_mm, surface_sd_exponent"),
        ("posterior", {"sd_scale": None, "offset_mm": 0.1}, "sd_scale"),
        ("posterior", {"sd_scale": 1.0, "offset_mm": 0.1, "sharpness": 0.0}, "sharpness"),
        ("typical", {"freedom": 9.0}, "rarity_mean"),
        ("typical", [1.0], "figures by name"),
        ("clusters", {"direction": [1.0, 0.0]}, "lack direction, shares, means, sd"),
        ("clusters", {"direction": [1, 0, 0], "shares": [0.5, 0.5], "means": [-1, 1], "sd": 0}, "lack sd"),
        ("clusters", [1.0], "a direction of 3 numbers"),
    ],
)
def test_a_value_that_cannot_be_is_named_with_what_is_accepted(bundle, name, value, naming):
    edit(bundle, **{name: value})
    assert name in refusal(bundle, BundleCorrupt, naming) or name == "latent_size"


def vouch_for(bundle, name):
    """Set down the digest that a file has now."""
    files = json.loads((bundle / MANIFEST).read_text())["files"]
    edit(bundle, files={**files, name: file_digest(bundle / name)})


def with_population(bundle, **changes):
    codes = np.zeros((5, 3))
    arrays = {"codes": codes, "base_codes": codes, "log_densities": np.zeros(5), "volumes_ml": np.ones(5), **changes}
    np.savez(bundle / POPULATION, **{name: values for name, values in arrays.items() if values is not None})
    vouch_for(bundle, POPULATION)


@pytest.mark.parametrize(
    ("changes", "naming"),
    [
        ({"codes": np.zeros((5, 2)), "base_codes": np.zeros((5, 2))}, "latent_size 3"),
        ({"base_codes": np.zeros((4, 3))}, "latent_size 3"),
        ({"codes": np.zeros(3), "base_codes": np.zeros(3)}, "latent_size 3"),
        ({"volumes_ml": None}, "lacks volumes_ml"),
        ({"log_densities": np.zeros(4)}, "as many log_densities as codes"),
        ({"volumes_ml": np.float64(1.0)}, "as many volumes_ml as codes"),
        ({"volumes_ml": np.array(["1"] * 5)}, "floating-point numbers"),
    ],
)
def test_a_population_of_another_size_is_refused(bundle, changes, naming):
    with_population(bundle, **changes)
    refusal(bundle, BundleCorrupt, naming)


@pytest.mark.parametrize("content", [b"", b"garbage", b"PK\x03\x04", "half", "one array", "objects"])
def test_a_population_that_cannot_be_parsed_is_refused(bundle, content):
    file = bundle / POPULATION
    if content == "half":
        file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    elif content == "one array":
        with file.open("wb") as stream:
            np.save(stream, np.zeros((5, 3)))
    elif content == "objects":
        np.savez(file, codes=np.array([{}, {}], dtype=object))
    else:
        file.write_bytes(content)
    vouch_for(bundle, POPULATION)
    refusal(bundle, BundleCorrupt, f"{POPULATION} cannot be parsed")


GRAPHS = ("decoder_logits", "decoder_jacobians", "prior_density", "prior_sampling_1")


@pytest.mark.parametrize("content", [b"", b"garbage", "half", "newer"])
@pytest.mark.parametrize("name", [f"{graph}.onnx" for graph in (*GRAPHS, "prior_base_jacobian")])
def test_a_graph_that_cannot_be_opened_is_named(bundle, name, content):
    file = bundle / name
    if content == "half":
        content = file.read_bytes()[: file.stat().st_size // 2]
    elif content == "newer":
        graph = onnx.load(file)
        graph.ir_version = 99
        content = graph.SerializeToString()
    file.write_bytes(content)
    vouch_for(bundle, name)
    refusal(bundle, BundleCorrupt, name)


@pytest.mark.parametrize("content", [b"", b"garbage"])
@pytest.mark.parametrize("graph", GRAPHS)
def test_a_torchscript_graph_that_cannot_be_opened_is_refused(bundle, graph, content):
    (bundle / f"{graph}.pt").write_bytes(content)
    vouch_for(bundle, f"{graph}.pt")
    refusal(bundle, BundleCorrupt, ".pt", backend="torchscript")


@pytest.mark.parametrize(
    "name",
    ["../x", "..", ".", "", "/etc/hostname", "sub/x.onnx", "..\\x", "C:x", "a\0b", "./decoder_logits.onnx"],
)
def test_files_outside_the_bundle_are_never_looked_at(bundle, name):
    (bundle.parent / "x").write_bytes(b"outside")
    files = json.loads((bundle / MANIFEST).read_text())["files"]
    edit(bundle, files={**files, name: hashlib.sha256(b"outside").hexdigest()})
    refusal(bundle, BundleCorrupt, MANIFEST)


@pytest.mark.parametrize("files", [None, [], ["decoder_logits.onnx"], "population.npz", 3])
def test_a_list_of_files_of_another_kind_is_refused(bundle, files):
    edit(bundle, files=files)
    refusal(bundle, BundleCorrupt, MANIFEST)


@pytest.mark.parametrize("name", REQUIRED_FILES)
def test_files_that_every_bundle_needs_must_be_listed(bundle, name):
    files = json.loads((bundle / MANIFEST).read_text())["files"]
    del files[name]
    edit(bundle, files=files)
    refusal(bundle, BundleIncomplete, name)


@pytest.mark.parametrize(("suffix", "backend"), [(".onnx", "onnx"), (".pt", "torchscript")])
def test_a_graph_that_the_manifest_does_not_vouch_for_is_refused(bundle, suffix, backend):
    name = f"prior_sampling_2{suffix}"
    shutil.copy(bundle / f"prior_sampling_0{suffix}", bundle / name)
    refusal(bundle, BundleCorrupt, name, backend)


def test_torchscript_graphs_must_be_listed_to_be_used(bundle):
    manifest, _ = read_manifest(bundle)
    for path in bundle.glob("*.pt"):
        path.unlink()
    write_manifest(replace(manifest, files={n: h for n, h in manifest.files.items() if not n.endswith(".pt")}), bundle)
    assert open_bundle(bundle, backend="onnx").manifest.name == "random"
    refusal(bundle, BundleCorrupt, "decoder_logits.pt", backend="torchscript")

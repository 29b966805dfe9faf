"""The command line: what it writes, what it refuses, and its exit status."""

import gzip
import json
import sys
import zipfile
from importlib.metadata import EntryPoint

import nibabel as nib
import numpy as np
import pytest
import trimesh
import typer

from model.errors import BundleCorrupt
from service.cli import BAD_INPUT, FAULT, build_app, command_names, example_request, interface_yaml, load_plugins, main
from service.model_registry import BrokenModel, ModelRegistry
from service.ports import MeshFormat
from service.settings import Settings
from tests.analytic_model import ellipsoid_model
from tests.dicom_parts import file_bytes, mr_series, seg_of
from tests.service_parts import NAME, mask_bytes, sparse_ellipsoid


def registry(_settings):
    return ModelRegistry({NAME: ellipsoid_model(NAME)}, [BrokenModel("half", "manifest.json is missing.")])


def run(*words):
    return main([str(word) for word in words], registry)


@pytest.fixture
def mask(tmp_path):
    file = tmp_path / "mask.nii"
    file.write_bytes(mask_bytes())
    return file


@pytest.mark.parametrize("format", list(MeshFormat))
def test_the_suffix_says_the_format(mask, tmp_path, format):
    target = tmp_path / f"surface.{format.value}"
    assert run("reconstruct", mask, "--output", target) == 0
    assert target.stat().st_size > 100


def test_a_surface_may_have_fewer_triangles(mask, tmp_path):
    full, fewer = tmp_path / "full.ply", tmp_path / "fewer.ply"
    assert run("reconstruct", mask, "--output", full) == 0
    assert run("reconstruct", mask, "--output", fewer, "--max-error-mm", 0.2) == 0
    assert len(trimesh.load(fewer).faces) < 0.7 * len(trimesh.load(full).faces)


def test_a_reconstruction_writes_all_that_is_asked_for(mask, tmp_path, capsys):
    surface, labels, entropy = (tmp_path / name for name in ("s.ply", "l.nii.gz", "e.nii.gz"))
    words = ("--output", surface, "--segmentation", labels, "--entropy", entropy, "--seed", 4, "--json")
    assert run("reconstruct", mask, *words) == 0
    told = capsys.readouterr()
    summary = json.loads(told.out)
    assert (summary["seed"], summary["model"]["name"], told.err) == (4, NAME, "")
    mesh = trimesh.load(surface)
    assert mesh.volume / 1000 == pytest.approx(summary["volume_ml"]["value"], rel=0.02)
    _, grid = sparse_ellipsoid()
    for file in (labels, entropy):
        image = nib.Nifti1Image.from_bytes(gzip.decompress(file.read_bytes()))
        assert image.shape == grid.shape
        np.testing.assert_allclose(image.affine, grid.affine, atol=1e-5)


def test_a_drawing_in_dicom_is_answered_in_its_own_world(tmp_path, capsys):
    drawing, target = tmp_path / "drawing.dcm", tmp_path / "surface.ply"
    drawing.write_bytes(file_bytes(seg_of(mr_series(), sparse_ellipsoid()[0])))
    assert run("reconstruct", drawing, "--output", target, "--uncertainty", "none", "--json") == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["space"] == "LPS"
    assert b"comment space LPS" in target.read_bytes()
    middle = trimesh.load(target).vertices.mean(axis=0)
    np.testing.assert_allclose(middle, summary["pose"]["position_mm"], atol=2.0)


def test_a_person_gets_sentences(mask, capsys):
    assert run("reconstruct", mask) == 0
    told = capsys.readouterr().out
    assert "mL" in told
    assert "90 %" in told


def test_files_are_not_overwritten_unless_forced(mask, tmp_path, capsys):
    target = tmp_path / "s.ply"
    target.write_text("precious")
    assert run("reconstruct", mask, "--output", target) == BAD_INPUT
    assert target.read_text() == "precious"
    assert "--force" in capsys.readouterr().err
    assert run("reconstruct", mask, "--output", target, "--force") == 0
    assert target.read_bytes()[:3] == b"ply"


@pytest.mark.parametrize(
    "words",
    [
        ("--output", "surface.txt"),
        ("--output", "nowhere/surface.ply"),
        ("--segmentation", "labels.nii"),
        ("--entropy", "e.nii.gz", "--uncertainty", "none"),
        ("--model", "spleen"),
        ("--label", "zero"),
        ("--annotated", "[]"),
        ("--resolution-mm", "0"),
        ("--resolution-mm", "nan"),
        ("--seed", "-1"),
        ("--uncertainty", "much"),
        ("--colour", "red"),
    ],
)
def test_bad_options_end_with_status_2(mask, words, capsys, monkeypatch):
    monkeypatch.chdir(mask.parent)
    assert run("reconstruct", mask, *words) == BAD_INPUT
    told = capsys.readouterr()
    assert told.out == ""
    assert "Traceback" not in told.err


@pytest.mark.parametrize("words", [("reconstruct",), ("jobs", "reconstruct")])
def test_a_surface_of_too_many_voxels_is_refused(mask, words, capsys, monkeypatch):
    monkeypatch.setenv("MORPHOFLOW_MAX_VOXELS", "50000")
    assert run(*words, mask, "--resolution-mm", "0.25") == BAD_INPUT
    assert "resolution_mm" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "part"),
    [(("--label", "255"), "label"), (("--annotated", '[{"stack": 1, "axis": 2, "index": 4}]'), "annotated[0]")],
)
def test_a_job_that_no_mask_can_be_used_for_is_refused_at_once(mask, words, part, capsys):
    assert run("jobs", "reconstruct", mask.parent, *words) == BAD_INPUT
    assert part in capsys.readouterr().err


def test_a_mask_that_is_not_there_is_named(mask, tmp_path, capsys):
    assert run("reconstruct", mask, tmp_path / "absent.nii") == BAD_INPUT
    assert str(tmp_path / "absent.nii") in capsys.readouterr().err


def test_a_folder_of_samples_equals_a_zip_of_them(tmp_path):
    folder, archive = tmp_path / "samples", tmp_path / "samples.zip"
    for target in (folder, archive):
        assert run("sample", "--count", 3, "--seed", 5, "--format", "ply", "--output", target) == 0
    with zipfile.ZipFile(archive) as opened:
        assert opened.namelist()[-1] == "manifest.json"
        assert {name: opened.read(name) for name in opened.namelist()} == {
            file.name: file.read_bytes() for file in folder.iterdir()
        }


def test_samples_for_machines_print_the_manifest(tmp_path, capsys):
    assert run("sample", "--count", 2, "--output", tmp_path / "s", "--format", "npz", "--json") == 0
    assert [item["seed"] for item in json.loads(capsys.readouterr().out)["samples"]] == [0, 1]


@pytest.mark.parametrize(
    "words",
    [
        ("--count", 0),
        ("--temperature", 0),
        ("--temperature", 3),
        ("--spacing-mm", 0),
        ("--spacing-mm", "nan"),
        ("--seed", -1),
        ("--format", "exe"),
    ],
)
def test_bad_sample_options_end_with_status_2(tmp_path, words, capsys):
    assert run("sample", "--output", tmp_path / "s", *words) == BAD_INPUT
    assert "Traceback" not in capsys.readouterr().err


def test_a_folder_that_holds_something_is_left_alone(tmp_path):
    (tmp_path / "note.txt").write_text("precious")
    assert run("sample", "--count", 1, "--output", tmp_path) == BAD_INPUT
    assert run("sample", "--count", 1, "--output", tmp_path / "note.txt") == BAD_INPUT
    assert [file.name for file in tmp_path.iterdir()] == ["note.txt"]


def test_modes_are_listed_by_rank(capsys):
    assert run("modes", "--count", 2, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert [mode["rank"] for mode in told["modes"]] == [1, 2]
    assert run("modes", "--count", 50) == 0
    assert "cumulative" in capsys.readouterr().out


def test_modes_are_written_as_mean_and_both_ends(tmp_path):
    folder = tmp_path / "modes"
    assert run("modes", "--count", 1, "--format", "stl", "--spacing-mm", 2, "--output", folder) == 0
    names = {f"{NAME}-{part}.stl" for part in ("mean", "mode1-minus", "mode1-plus")}
    assert {file.name for file in folder.iterdir()} == names
    assert run("modes", "--count", 1, "--format", "stl", "--spacing-mm", 2, "--output", folder) == BAD_INPUT
    assert run("modes", "--count", 1, "--format", "stl", "--spacing-mm", 3, "--output", folder, "--force") == 0


def test_modes_that_cannot_be_written_are_told_in_a_sentence(tmp_path, capsys):
    (tmp_path / "file").touch()
    assert run("modes", "--count", 1, "--spacing-mm", 3, "--output", tmp_path / "file" / "below") == BAD_INPUT
    assert capsys.readouterr().err.startswith("morphoflow: --output cannot be written: ")


@pytest.mark.parametrize("words", [("--sd", 6), ("--count", 0), ("--spacing-mm", "nan"), ("--format", "nifti")])
def test_bad_mode_options_end_with_status_2(tmp_path, words, capsys):
    assert run("modes", "--output", tmp_path / "m", *words) == BAD_INPUT
    assert "Traceback" not in capsys.readouterr().err


def test_models_are_listed_and_broken_ones_named(capsys):
    assert run("models", "--json") == 0
    told = capsys.readouterr()
    assert [model["name"] for model in json.loads(told.out)["models"]] == [NAME]
    assert "manifest.json is missing." in told.err
    assert run("models") == 0
    assert NAME in capsys.readouterr().out


def test_a_fault_of_a_model_ends_with_status_1(capsys):
    def broken(_settings):
        raise BundleCorrupt("The file weights.onnx differs from its recorded hash.")

    assert main(["models"], broken) == FAULT
    assert "differs" in capsys.readouterr().err


def test_serving_the_network_without_a_key_is_refused(capsys, monkeypatch):
    monkeypatch.delenv("MORPHOFLOW_API_KEYS", raising=False)
    assert run("serve", "--host", "0.0.0.0") == BAD_INPUT
    assert "MORPHOFLOW_API_KEYS" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, "http://127.0.0.1:8000/v1/reconstructions"),
        ({"host": "0.0.0.0", "port": 81, "api_keys": ("hush",)}, "http://127.0.0.1:81/v1"),
        ({"host": "::1"}, "http://[::1]:8000/v1"),
        ({"root_path": "/shape"}, ":8000/shape/v1"),
    ],
)
def test_the_ready_request_names_the_address_and_no_key(changes, expected):
    request = example_request(Settings(**changes), ["bone"])
    assert expected in request
    assert "hush" not in request
    assert ("X-API-Key" in request) is ("api_keys" in changes)


def test_the_ready_request_names_a_model_where_several_are_loaded():
    assert "model=" not in example_request(Settings(), ["bone"])
    assert " -F model=bone -F mask=" in example_request(Settings(), ["bone", "organ"])


@pytest.mark.parametrize(
    ("words", "library", "setting", "extra"),
    [
        (("serve",), "pydicom", ("MORPHOFLOW_PACS_FILE", "pacs.toml"), "pacs"),
        (("worker",), "pynetdicom", ("MORPHOFLOW_PACS_FILE", "pacs.toml"), "pacs"),
        (("serve",), "boto3", ("MORPHOFLOW_STORAGE_URL", "s3://m"), "cluster"),
        (("worker",), "boto3", ("MORPHOFLOW_STORAGE_URL", "s3://m"), "cluster"),
        (("deidentify", ".", "--output", "absent"), "dicomanonymizer", ("MORPHOFLOW_PORT", "8000"), "pacs"),
    ],
)
def test_what_lacks_an_extra_says_how_to_install_it(words, library, setting, extra, capsys, monkeypatch):
    monkeypatch.setenv(*setting)
    monkeypatch.setitem(sys.modules, library, None)
    assert run(*words) == BAD_INPUT
    told = capsys.readouterr().err
    assert told.endswith(f"needs the extra {extra}: pip install -c constraints.txt '.[{extra}]'\n")
    assert told.count("\n") == 1


def test_the_interface_is_written_to_a_file(tmp_path):
    assert run("openapi", "--output", tmp_path / "o.yaml") == 0
    assert (tmp_path / "o.yaml").read_text() == interface_yaml()


@pytest.mark.parametrize(
    "words",
    [
        ("openapi", "--output", "/proc/absent/o.yaml"),
        ("sample", "--count", 1, "--output", "/proc/absent/s"),
        ("sample", "--count", 1, "--output", "/proc/s.zip"),
    ],
)
def test_what_cannot_be_written_is_told_in_a_sentence(words, capsys):
    assert run(*words) == BAD_INPUT
    assert capsys.readouterr().err.startswith("morphoflow: --output cannot be written: ")


@pytest.mark.parametrize("words", [(), ("--help",), ("--version",)])
def test_help_and_version(words, capsys):
    assert run(*words) == 0
    assert capsys.readouterr().out.strip()


def test_an_unknown_command_ends_with_status_2():
    assert run("dance") == BAD_INPUT


def register(app):
    """What another package's entry point names."""

    @app.command()
    def dance():
        pass


def test_other_packages_add_commands():
    app = build_app()
    assert load_plugins(app, [EntryPoint("extra", f"{__name__}:register", "morphoflow.commands")]) == []
    assert "dance" in command_names(app)


def test_a_package_that_lacks_a_library_says_what_to_install():
    app = typer.Typer()
    (sentence,) = load_plugins(app, [EntryPoint("training", "nowhere_at_all.cli:register", "morphoflow.commands")])
    assert "nowhere_at_all" in sentence
    assert sentence.endswith("pip install -c constraints.txt '.[training]'")


def test_a_run_in_a_pipe_writes_nothing_but_the_answer(tmp_path, capsys):
    assert run("sample", "--count", 1, "--output", tmp_path / "s") == 0
    assert capsys.readouterr().err == ""
    assert (tmp_path / "s" / "manifest.json").is_file()

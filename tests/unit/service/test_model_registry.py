"""One broken model does not stop the others."""

import errno
import gc
import os
import shutil
import weakref
from dataclasses import replace
from pathlib import Path

import pytest

from model.errors import BundleCorrupt, BundleIncomplete, InvalidParameter, UnknownModel
from service.model_registry import MANIFEST, ModelRegistry, OpenedOnce, find_bundles, load_models, load_registry
from service.schemas import BrokenModelSchema
from service.settings import Settings
from tests.analytic_model import ellipsoid_model


def opener(found):
    def open_model(folder):
        answer = found[folder.name]
        if isinstance(answer, Exception):
            raise answer
        return answer

    return open_model


def test_broken_bundles_are_reported_beside_the_loaded_ones(tmp_path):
    found = {"a": ellipsoid_model("a"), "b": BundleCorrupt("weights.onnx differs."), "c": ellipsoid_model("c")}
    found["d"] = OSError("/secret/path")
    registry = load_models([tmp_path / name for name in found], opener(found))
    assert registry.names() == ("a", "c")
    assert [item.name for item in registry.broken] == ["b", "d"]
    assert not any("/secret" in item.reason for item in registry.broken)


def test_of_two_models_with_one_name_the_first_stays(tmp_path):
    first, second = ellipsoid_model("a"), ellipsoid_model("a", (5.0, 5.0, 5.0))
    registry = load_models([tmp_path / "x", tmp_path / "y"], opener({"x": first, "y": second}))
    assert registry.get("a") is first
    assert [item.name for item in registry.broken] == ["y"]


def test_the_only_model_needs_no_name():
    only = ellipsoid_model("a")
    assert ModelRegistry({"a": only}).get(None) is only


@pytest.mark.parametrize("names", [(), ("a", "b")])
def test_without_a_name_there_must_be_exactly_one(names):
    with pytest.raises(InvalidParameter) as caught:
        ModelRegistry({name: ellipsoid_model(name) for name in names}).get(None)
    assert caught.value.part == "model"
    assert all(name in str(caught.value) for name in names)


def test_an_unknown_name_is_told_the_known_ones():
    with pytest.raises(UnknownModel, match="hip"):
        ModelRegistry({"hip": ellipsoid_model("hip")}).get("hop")


def test_a_folder_is_a_bundle_or_holds_bundles(tmp_path):
    for name in ("b", "a"):
        (tmp_path / name).mkdir()
        (tmp_path / name / MANIFEST).write_text("{}")
    (tmp_path / "half").mkdir()
    (tmp_path / "file").write_text("")
    (tmp_path / ".hidden").mkdir()
    assert [folder.name for folder in find_bundles(tmp_path)] == ["a", "b", "half"]
    assert list(find_bundles(tmp_path / "a")) == [tmp_path / "a"]
    assert list(find_bundles(tmp_path / "nowhere")) == []


def test_a_folder_that_is_not_there_is_told_of_without_its_path_until_it_comes(tmp_path):
    root = tmp_path / "secret" / "typo"
    registry = load_registry(Settings(models=(root,), shipped_models=False))
    (absent,) = registry.broken
    assert absent.name == "typo"
    assert "MORPHOFLOW_MODELS" in absent.reason
    assert "secret" not in absent.reason
    root.mkdir(parents=True)
    assert registry.refresh()
    assert registry.broken == ()


def test_a_folder_without_a_manifest_counts_as_broken(tmp_path):
    registry = load_models([tmp_path / "half"], opener({"half": BundleIncomplete("manifest.json is missing.")}))
    assert registry.broken[0].reason == "manifest.json is missing."


def versioned(version, axes=(10.0, 8.0, 7.0)):
    model = ellipsoid_model("hip", axes)
    return replace(model, manifest=replace(model.manifest, version=version))


def test_versions_stand_side_by_side_and_the_newest_has_the_plain_name(tmp_path):
    found = {"x": versioned("1.10.0"), "y": versioned("1.9.0", (9.0, 9.0, 9.0))}
    registry = load_models([tmp_path / name for name in found], opener(found))
    assert registry.names() == ("hip",)
    assert registry.get("hip") is registry.get(None) is found["x"]
    assert registry.get("hip@1.9.0") is found["y"]
    with pytest.raises(UnknownModel, match=r"version; loaded are: hip@1\.9\.0, hip@1\.10\.0\.$"):
        registry.get("hip@2.0.0")
    with pytest.raises(UnknownModel, match=r"name; loaded are: hip\.$"):
        registry.get("hi@1.9.0")


@pytest.mark.parametrize(
    ("older", "newer"),
    [("1.3.0-rc1", "1.3.0"), ("1.2.9", "1.3.0-rc1"), ("2025b", "2026a"), ("v2", "v10"), ("1.3.0", "1.3.0.post1")],
)
def test_what_comes_before_a_release_is_older_than_it(tmp_path, older, newer):
    for order in ((older, newer), (newer, older)):
        found = {name: versioned(version) for name, version in zip("xy", order, strict=True)}
        registry = load_models([tmp_path / name for name in found], opener(found))
        assert registry.get("hip").manifest.version == newer


def test_models_are_found_again(tmp_path):
    found = {"x": versioned("1.0.0")}
    registry = ModelRegistry(
        {"hip": found["x"]}, reload=lambda: load_models([tmp_path / name for name in found], opener(found))
    )
    assert not registry.refresh()
    found["y"] = versioned("1.1.0", (9.0, 9.0, 9.0))
    assert registry.refresh()
    assert registry.get("hip") is found["y"]
    del found["x"]
    assert registry.refresh()
    with pytest.raises(UnknownModel):
        registry.get("hip@1.0.0")


def test_a_bundle_is_opened_again_only_when_its_manifest_changes(tmp_path):
    opened = []
    once = OpenedOnce(lambda folder: opened.append(folder) or versioned("1.0.0"))
    (tmp_path / MANIFEST).write_text("{}")
    assert once(tmp_path) is once(tmp_path)
    (tmp_path / MANIFEST).write_text("{} ")
    once(tmp_path)
    assert len(opened) == 2


def test_a_bundle_that_is_gone_is_forgotten_and_one_that_comes_back_is_opened_again(tmp_path):
    opened = []
    once = OpenedOnce(lambda folder: opened.append(folder) or versioned("1.0.0"))
    (tmp_path / MANIFEST).write_text("{}")
    once(tmp_path)
    once.forget_all_but([tmp_path])
    once(tmp_path)
    assert len(opened) == 1
    once.forget_all_but([])
    once(tmp_path)
    assert len(opened) == 2


def test_a_removed_bundle_takes_no_memory(shipped_bundles, tmp_path):
    folder = shutil.copytree(shipped_bundles[0], tmp_path / "models" / "bone")
    registry = load_registry(Settings(shipped_models=False, models=(folder.parent,), threads=1))
    model = weakref.ref(registry.get(None))
    assert model() is not None
    shutil.rmtree(folder)
    assert registry.refresh()
    gc.collect()
    assert model() is None


def test_models_are_kept_while_the_program_has_no_more_files_to_open(tmp_path):
    found = {"x": versioned("1.0.0")}
    registry = ModelRegistry(
        {"hip": found["x"]}, reload=lambda: load_models([tmp_path / name for name in found], opener(found))
    )
    found["x"] = OSError(errno.EMFILE, "Too many open files")
    with pytest.raises(OSError, match="Too many"):
        registry.refresh()
    assert registry.names() == ("hip",)


def test_a_bundle_that_is_broken_by_now_takes_no_memory_and_is_tried_again(tmp_path):
    tries = iter(range(3))

    def open_model(_):
        if next(tries) == 1:
            raise BundleCorrupt("weights.onnx differs.")
        return versioned("1.0.0")

    once = OpenedOnce(open_model)
    (tmp_path / MANIFEST).write_text("{}")
    first = weakref.ref(once(tmp_path))
    (tmp_path / MANIFEST).write_text("{} ")
    with pytest.raises(BundleCorrupt):
        once(tmp_path)
    gc.collect()
    assert first() is None
    assert once(tmp_path).manifest.version == "1.0.0"


def test_a_name_that_is_no_text_is_told_as_one_that_can_be_sent():
    folder = Path(os.fsdecode(b"bone\xff"))
    (broken,) = load_models([folder], opener({folder.name: BundleIncomplete("It lacks \ud800.")})).broken
    assert (broken.name, broken.reason) == ("bone?", "It lacks ?.")
    assert BrokenModelSchema(name=broken.name, reason=broken.reason).model_dump_json()

"""The conformance statement says what the code does."""

import subprocess
import sys
from pathlib import Path

import pytest

from service.adapters.dicom.masks import DRAWINGS
from service.adapters.pacs import conformance, sop_classes


def test_the_statement_holds_the_codes_tables(repository: Path):
    page = (repository / "docs" / "dicom-conformance.md").read_text(encoding="utf-8")
    assert conformance.network_table() in page
    assert conformance.syntax_table() in page


def test_every_setting_of_the_file_stands_in_the_docs(repository: Path):
    assert conformance.settings_tables() in (repository / "docs" / "dicom.md").read_text(encoding="utf-8")


def test_every_drawing_that_is_read_is_accepted():
    assert all(uid in conformance.network_table() for uid in DRAWINGS)


def test_one_command_prints_the_tables(repository: Path):
    command = [sys.executable, "-m", "service.adapters.pacs.conformance"]
    told = subprocess.run(command, cwd=repository, capture_output=True, text=True, check=True).stdout
    for table in (conformance.network_table(), conformance.syntax_table(), conformance.settings_tables()):
        assert table in told


@pytest.mark.parametrize("classes", [["1.2.840.10008.5.1.4.1.1.4"], sop_classes.IMAGES])
def test_each_image_class_is_proposed_in_each_syntax_within_one_association(classes):
    contexts = sop_classes.image_contexts(classes)
    assert len(contexts) <= 126
    proposed = {(context.abstract_syntax, syntax) for context in contexts for syntax in context.transfer_syntax}
    assert proposed == {(uid, syntax) for uid in classes for syntax in sop_classes.IMAGE_SYNTAXES}


def test_image_classes_are_storage_classes():
    assert sop_classes.STORAGE.issuperset(sop_classes.IMAGES)
    names = " ".join(uid.name for uid in sop_classes.IMAGES)
    assert all(name in names for name in ("Nuclear", "Tomosynthesis", "Craniofacial", "US Volume", "Enhanced PET"))

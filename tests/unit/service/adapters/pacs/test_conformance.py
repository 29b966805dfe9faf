"""The conformance statement says what the code does."""

from pathlib import Path

from service.adapters.dicom.masks import DRAWINGS
from service.adapters.pacs import conformance


def test_the_statement_holds_the_codes_tables(repository: Path):
    page = (repository / "docs" / "dicom-conformance.md").read_text(encoding="utf-8")
    assert conformance.network_table() in page
    assert conformance.syntax_table() in page


def test_every_setting_of_the_file_stands_in_the_docs(repository: Path):
    assert conformance.settings_tables() in (repository / "docs" / "dicom.md").read_text(encoding="utf-8")


def test_every_drawing_that_is_read_is_accepted():
    assert all(uid in conformance.network_table() for uid in DRAWINGS)

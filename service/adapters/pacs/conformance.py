"""Tables of the DICOM Conformance Statement (PS3.2), from the tables that the code itself works with.

``python -m service.adapters.pacs.conformance`` prints them as they stand in the documentation.
"""

import sys
from collections.abc import Iterable, Sequence

from pydantic import BaseModel
from pydicom.uid import UID

from service.adapters.pacs import sop_classes
from service.adapters.pacs.configuration import Archive, Listener, MoveDestination, PacsConfiguration, Rule, Tls

#: Parts of the file of rules and the headings that they stand under.
SECTIONS: dict[str, type[BaseModel]] = {
    "top of the file": PacsConfiguration,
    "`[listener]`": Listener,
    "`[[archives]]`": Archive,
    "`[archives.move]`": MoveDestination,
    "`tls`, in `[listener]` and `[[archives]]`": Tls,
    "`[[rules]]`": Rule,
}


def network_table() -> str:
    """SOP classes, roles and transfer syntaxes of DIMSE."""
    rows: list[Sequence[object]] = [
        (_name(sop_classes.VERIFICATION), sop_classes.VERIFICATION, "yes", "yes", "proposed")
    ]
    rows += [(_name(uid), uid, "", "yes", "accepted") for uid in sop_classes.RECEIVED]
    rows += [("every other storage class of PS3.4, B.5", "", "", "left alone", "accepted, and those of images")]
    rows += [(_name(uid), uid, "yes", "", "proposed") for uid in sop_classes.SENT]
    rows += [(_name(uid), uid, "", "by C-GET, C-MOVE", "proposed for images") for uid in sop_classes.IMAGES]
    query = (sop_classes.FIND, sop_classes.GET, sop_classes.MOVE, sop_classes.COMMITMENT)
    rows += [(_name(uid), uid, "yes", "", "proposed") for uid in query]
    return _table(("SOP class", "UID", "SCU", "SCP", "transfer syntaxes"), rows)


def syntax_table() -> str:
    """Transfer syntaxes that are accepted and proposed; those of images for what is left alone and what is fetched."""
    others = [uid for uid in sop_classes.LEFT_ALONE_SYNTAXES if uid not in sop_classes.ACCEPTED_SYNTAXES]
    rows = [(uid.name, uid, "yes", _proposed(uid)) for uid in sop_classes.ACCEPTED_SYNTAXES]
    rows += [(uid.name, uid, "of images", _proposed(uid)) for uid in others]
    return _table(("transfer syntax", "UID", "accepted", "proposed"), rows)


def settings_tables() -> str:
    """Every value of the file of rules, by section."""
    parts = []
    for heading, section in SECTIONS.items():
        rows = [
            (f"`{name}`", field.description or "", _default(field.default))
            for name, field in section.model_fields.items()
            if not (section is PacsConfiguration and name in ("listener", "archives", "rules"))
        ]
        parts.append(f"{heading}\n\n" + _table(("value", "meaning", "default"), rows))
    return "\n\n".join(parts)


def _name(uid: UID) -> str:
    return "Label Map Segmentation Storage" if uid.name == str(uid) else uid.name


def _proposed(uid: UID) -> str:
    if uid in sop_classes.PROPOSED_SYNTAXES:
        return "yes"
    return "for images" if uid in sop_classes.IMAGE_SYNTAXES else ""


def _default(value: object) -> str:
    if value is None or value == () or "Undefined" in str(value):
        return ""
    return f"`{value}`"


def _table(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)


if __name__ == "__main__":
    sys.stdout.write("\n\n".join([network_table(), syntax_table(), settings_tables()]) + "\n")

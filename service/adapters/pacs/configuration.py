"""The one file that says how the service stands among archives: who may send, what goes to which model, and whither.

TOML, read once at the start; unknown names are refused.
"""

import tomllib
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError, model_validator

from model.errors import InvalidParameter

#: Application entity title (PS3.5, VR AE).
AeTitle = Annotated[str, StringConstraints(min_length=1, max_length=16, pattern=r"^[\x21-\x5b\x5d-\x7e]+$")]
Port = Annotated[int, Field(ge=1, le=65535)]
#: Stands for objects that came by STOW-RS in the rules' list of senders.
STOW_SENDER = "STOW-RS"


class _Closed(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Tls(_Closed):
    """Certificates in PEM; both sides show one."""

    certificate: Path = Field(description="own certificate (PEM)")
    key: Path = Field(description="its private key (PEM)")
    authorities: Path = Field(description="certificates that vouch for the peer's (PEM)")


class Listener(_Closed):
    """Where DIMSE associations are accepted, and from whom."""

    ae_title: AeTitle = Field("MORPHOFLOW", description="title that callers must call")
    host: str = Field("127.0.0.1", description="address to listen on")
    port: Port = Field(11112, description="port to listen on")
    calling_ae_titles: tuple[AeTitle, ...] = Field(min_length=1, description="who may associate")
    maximum_associations: int = Field(100, ge=1, description="associations at the same time; more are turned away")
    tls: Tls | None = Field(None, description="associations over TLS; both sides show a certificate")


class MoveDestination(_Closed):
    """Where images arrive that are fetched by C-MOVE; the archive must know this title and address."""

    ae_title: AeTitle = Field(description="title that the archive knows")
    host: str = Field("127.0.0.1", description="address to listen on")
    port: Port = Field(description="port to listen on")


class Archive(_Closed):
    """A picture archive, reached by DICOMweb or by DIMSE."""

    name: str = Field(min_length=1, description="how rules call it")
    dicomweb: str | None = Field(None, description="base address of its DICOMweb services")
    authorization_file: Path | None = Field(None, description="file with the value of the header Authorization")
    authorities: Path | None = Field(None, description="certificates that vouch for the archive's (PEM)")
    ae_title: AeTitle | None = Field(None, description="its title, when it is reached by DIMSE")
    host: str = Field("127.0.0.1", description="its address (DIMSE)")
    port: Port = Field(104, description="its port (DIMSE)")
    local_ae_title: AeTitle = Field("MORPHOFLOW", description="title that the service calls with")
    tls: Tls | None = Field(None, description="TLS with an own certificate (DIMSE and DICOMweb)")
    move: MoveDestination | None = Field(None, description="fetch by C-MOVE to here; by C-GET when left out")
    commitment: bool = Field(False, description="ask for storage commitment (DIMSE)")
    commitment_awaited_s: float = Field(3600.0, gt=0, description="wait for its report before it is asked again")
    timeout_s: float = Field(30.0, gt=0, description="longest wait for an answer (s)")

    @model_validator(mode="after")
    def _has_one_way(self) -> "Archive":
        if (self.dicomweb is None) == (self.ae_title is None):
            raise ValueError("an archive needs either dicomweb or ae_title")
        return self


class Rule(_Closed):
    """Which drawings go to which model, and where its results go. All conditions that are given must hold."""

    name: str = Field(min_length=1, description="how logs and jobs call it")
    model: str = Field(description="model that reconstructs")
    senders: tuple[str, ...] = Field((), description=f"calling AE titles, or {STOW_SENDER}; anybody when empty")
    segment_codes: tuple[str, ...] = Field((), description="SCHEME:VALUE of the property type; any when empty")
    segment_labels: tuple[str, ...] = Field((), description="labels or ROI names, * and ? allowed; any when empty")
    body_parts: tuple[str, ...] = Field((), description="Body Part Examined; any when empty")
    fetch_from: str = Field(description="archive that has the images")
    send_to: tuple[str, ...] = Field(min_length=1, description="archives that get the results")
    uncertainty: Literal["laplace", "ensemble"] = Field("laplace", description="how uncertainty is found")
    mirror: Literal["auto", "never", "always"] = Field("never", description="whether left and right are exchanged")
    seed: int = Field(0, ge=0, description="makes results repeatable")


class PacsConfiguration(_Closed):
    """All of the file."""

    listener: Listener | None = None
    archives: tuple[Archive, ...] = ()
    rules: tuple[Rule, ...] = ()
    audit_file: Path | None = Field(None, description="audit trail; beside the jobs' files when left out")
    retry_first_s: float = Field(1.0, gt=0, description="wait before an unreachable archive is tried again; doubles")
    retry_longest_s: float = Field(300.0, gt=0, description="longest such wait")
    images_awaited_s: float = Field(3600.0, ge=0, description="how long images may come after the drawing on them")

    @model_validator(mode="after")
    def _names_are_known(self) -> "PacsConfiguration":
        known = {archive.name for archive in self.archives}
        if len(known) < len(self.archives) or len({rule.name for rule in self.rules}) < len(self.rules):
            raise ValueError("archives and rules need different names")
        for rule in self.rules:
            if not known.issuperset({rule.fetch_from, *rule.send_to}):
                raise ValueError("a rule names an archive that is not listed")
        return self

    def archive(self, name: str) -> Archive:
        """An archive by name."""
        return next(archive for archive in self.archives if archive.name == name)

    def rule(self, name: str) -> Rule:
        """A rule by name.

        Raises:
            InvalidParameter: none of that name; the file has changed since.
        """
        found = next((rule for rule in self.rules if rule.name == name), None)
        if found is None:
            raise InvalidParameter("The rule that accepted this object is no longer in the file of rules.", part="rule")
        return found


def load_configuration(path: Path) -> PacsConfiguration:
    """Read the file.

    Raises:
        InvalidParameter: not there, no TOML, or a value that is not accepted; the sentence names it.
    """
    try:
        return PacsConfiguration.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))
    except ValidationError as fault:
        first = fault.errors(include_input=False)[0]
        name = ".".join(map(str, first["loc"])) or "file"
        raise InvalidParameter(f"The DICOM setting {name} is not valid: {first['msg']}.", part=name) from None
    except (OSError, ValueError):
        raise InvalidParameter("MORPHOFLOW_PACS_FILE must name a readable TOML file.", part="pacs_file") from None

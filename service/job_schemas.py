"""Wire types of jobs."""

from datetime import datetime
from typing import Any, Literal

from fastapi import UploadFile
from pydantic import BaseModel, ConfigDict, Field, field_validator

from model.errors import InvalidParameter
from model.inference.calipers import USUAL_TEXT, parse_extents
from model.inference.stacks import checked_labels
from service.job_ports import JobState
from service.ports import RECONSTRUCTIONS_JOB, SAMPLES_JOB, MeshFormat, SampleFormat
from service.request_schemas import Seed, SpacingMm, parse_annotated, parse_labels

_OF_SAMPLES = ("count", "temperature", "spacing_mm", "reject")
_OF_RECONSTRUCTIONS = ("archive", "label", "annotated", "uncertainty", "mirror", "resolution_mm", "fidelity", "extents")


class JobForm(BaseModel):
    """The parts of a request for a job."""

    model_config = ConfigDict(extra="forbid")

    kind: Literal["samples", "reconstructions"] = Field(
        description="bulk sampling, or one reconstruction for each mask"
    )
    model: str | None = Field(
        None, description="model name, or name@version; may be left out when only one model is loaded"
    )
    format: SampleFormat = Field(SampleFormat.STL, description="file format; a mesh format for reconstructions")
    seed: Seed = 0
    count: int = Field(16, ge=1, description="of samples: how many")
    temperature: float = Field(
        1.0, gt=0.0, le=2.0, allow_inf_nan=False, description="of samples: spread of the shapes; 1 is the population's"
    )
    spacing_mm: SpacingMm | None = Field(None, description="of samples: grid step (mm); the model's when left out")
    reject: bool = Field(True, description="of samples: draw anew where a shape is implausible")
    archive: UploadFile | None = Field(None, description="of reconstructions: a ZIP of masks, each of one object")
    label: list[str] = Field(default_factory=list, description="of reconstructions: as of a single one")
    annotated: str = Field("auto", description="of reconstructions: as of a single one")
    uncertainty: Literal["laplace", "ensemble", "none"] = Field(
        "laplace", description="of reconstructions: as of a single one"
    )
    mirror: Literal["auto", "never", "always"] = Field("never", description="of reconstructions: as of a single one")
    resolution_mm: SpacingMm | None = Field(None, description="of reconstructions: as of a single one")
    fidelity: float | None = Field(
        None, ge=0.0, le=1.0, allow_inf_nan=False, description="of reconstructions: as of a single one"
    )
    extents: str = Field(USUAL_TEXT, description="of reconstructions: as of a single one")

    @field_validator("label")
    @classmethod
    def _leave_out_blank(cls, texts: list[str]) -> list[str]:
        return [text for text in texts if text.strip()]

    def argument(self) -> dict[str, Any]:
        """The job's argument, checked, with the model as it was asked for.

        Raises:
            InvalidParameter: a part belongs to the other kind, is missing, or out of its range.
        """
        other = _OF_RECONSTRUCTIONS if self.kind == SAMPLES_JOB else _OF_SAMPLES
        for name in other:
            if name in self.model_fields_set and getattr(self, name) != []:  # blank labels, as forms of pages send them
                raise InvalidParameter(f"The parameter {name} is of no use to a job of kind {self.kind}.", part=name)
        shared = {"model": self.model, "format": self.format.value, "seed": self.seed}
        return {**shared, **(self._samples() if self.kind == SAMPLES_JOB else self._reconstructions())}

    def _samples(self) -> dict[str, Any]:
        return self.model_dump(include=set(_OF_SAMPLES))

    def _reconstructions(self) -> dict[str, Any]:
        if self.archive is None:
            raise InvalidParameter(
                f"A job of kind {RECONSTRUCTIONS_JOB} needs the part archive, a ZIP.", part="archive"
            )
        if self.format.value not in tuple(MeshFormat):
            raise InvalidParameter(f"The parameter format must be one of: {', '.join(MeshFormat)}.", part="format")
        parse_annotated(self.annotated)
        checked_labels(parse_labels(self.label))
        parse_extents(self.extents)
        return self.model_dump(include=set(_OF_RECONSTRUCTIONS) - {"archive"})


class JobLinks(BaseModel):
    """Where a job and what it made are."""

    self: str
    events: str
    result: str | None = Field(description="what it made, from when it is done until that is gone")


class JobSummary(BaseModel):
    """Where a job stands."""

    id: str
    kind: str = Field(description="samples, reconstructions or reconstruction")
    state: JobState
    created: datetime
    started: datetime | None
    finished: datetime | None
    done: int = Field(description="items that are made")
    total: int = Field(description="items in all; 0 until it is known")
    remaining_s: float | None = Field(description="estimated time to its end (s); null while nothing is known")
    problem: str | None = Field(description="why it failed, or that what it made is gone")
    problem_type: str | None = Field(
        description="stable name of the kind of that problem, as a request that is waited for would be answered with"
    )
    problem_status: int | None = Field(description="HTTP status of that kind")
    links: JobLinks

"""Settings of the service: environment variables ``MORPHOFLOW_*`` and an optional TOML file.

Nothing is read at import; `load_settings` reads the environment once, when a program starts.
"""

import ipaddress
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import urlsplit

from pydantic import Field, SecretStr, ValidationError, field_validator
from pydantic_settings import (
    BaseSettings,
    NoDecode,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
    TomlConfigSettingsSource,
)
from sqlalchemy.engine import make_url
from sqlalchemy.exc import ArgumentError

from model.errors import InvalidParameter
from service.job_archives import ArchiveLimits

#: Names a TOML file with settings; the environment overrides it.
SETTINGS_FILE_VARIABLE = "MORPHOFLOW_SETTINGS_FILE"

#: A hundred years (s): dates of what is kept for longer may be beyond the last one that a calendar has.
LONGEST_LIFETIME_S = 100 * 365 * 86400.0
#: Kinds of databases that jobs may be kept in.
DATABASES = ("postgresql", "postgres", "sqlite")


def default_results_folder() -> Path:
    """Where results are kept unless a setting says otherwise: the user's state folder."""
    return Path.home() / ".local" / "state" / "morphoflow" / "results"


class Settings(BaseSettings):
    """All settings; each field is the environment variable ``MORPHOFLOW_<FIELD>``."""

    model_config = SettingsConfigDict(env_prefix="MORPHOFLOW_", extra="forbid", frozen=True, allow_inf_nan=False)

    host: str = Field("127.0.0.1", description="address to listen on")
    port: int = Field(8000, ge=1, le=65535, description="port to listen on")
    root_path: str = Field("", description="path prefix that a reverse proxy strips")
    models: Annotated[tuple[Path, ...], NoDecode] = Field(
        (), description="folders with further models, separated as in PATH; each a bundle or a folder of bundles"
    )
    shipped_models: bool = Field(True, description="whether the models that ship with the program are loaded")
    backend: Literal["onnx", "torchscript"] = Field("onnx", description="what evaluates the networks")
    threads: int | None = Field(
        None, ge=1, le=256, description="threads of one evaluation; the backend decides if unset"
    )
    api_keys: Annotated[tuple[SecretStr, ...], NoDecode] = Field(
        (), description="accepted keys, separated by commas; a key is asked for as soon as one is set"
    )
    allow_open: bool = Field(False, description="allow to listen on a public address without a key")
    results_folder: Path = Field(default_factory=default_results_folder, description="where results are kept")
    result_lifetime_s: float = Field(86400.0, gt=0, le=LONGEST_LIFETIME_S, description="how long a result is served")
    results_max_bytes: int = Field(10 * 2**30, ge=1, description="results kept together; the oldest go first")
    sweep_interval_s: float = Field(60.0, gt=0, le=86400.0, description="how often expired results are removed")
    max_body_bytes: int = Field(256 * 2**20, ge=1, description="largest request body")
    max_voxels: int = Field(2**27, ge=1, description="most voxels of a mask after decompression, and of an answer")
    max_masks: int = Field(8, ge=1, description="most mask parts of a request")
    max_samples: int = Field(256, ge=1, description="most shapes of a batch")
    workers: int = Field(2, ge=1, le=256, description="reconstructions and samples computed at the same time")
    max_waiting: int = Field(8, ge=0, description="requests that may wait for a worker")
    jobs_database: SecretStr = Field(
        SecretStr(""), description="where jobs are kept: postgresql://user@host/name; a file of SQLite when left out"
    )
    storage_url: str = Field("", description="where results and files of jobs are kept: s3://bucket/prefix")
    storage_endpoint: str = Field("", description="address of S3-compatible storage other than Amazon's")
    replica: str = Field("", description="name of this machine among the others; the host's when left out")
    job_workers: int = Field(1, ge=0, le=256, description="processes beside the service that do jobs")
    job_nice: int = Field(15, ge=0, le=19, description="how far jobs stand back behind requests (nice)")
    job_lease_s: float = Field(
        10.0, ge=1.0, le=3600.0, description="a job worker not seen for so long is taken for gone"
    )
    max_jobs: int = Field(64, ge=0, description="jobs that may wait or run")
    max_job_samples: int = Field(100_000, ge=1, description="most shapes of a job")
    max_job_masks: int = Field(10_000, ge=1, description="most masks of a job")
    max_job_bytes: int = Field(4 * 2**30, ge=1, description="masks of a job together, unpacked")
    pacs_file: Path | None = Field(
        None, description="TOML file that says how the service stands among picture archives; no DICOM when left out"
    )
    retry_after_s: int = Field(10, ge=1, le=86400, description="when a refused client is told to come back")
    log_level: Literal["debug", "info", "warning", "error"] = Field("info", description="least severe entry logged")

    @field_validator("models", mode="before")
    @classmethod
    def _split_paths(cls, value: object) -> object:
        return tuple(filter(None, value.split(os.pathsep))) if isinstance(value, str) else value

    @field_validator("api_keys", mode="before")
    @classmethod
    def _split_keys(cls, value: object) -> object:
        return tuple(filter(None, map(str.strip, value.split(",")))) if isinstance(value, str) else value

    @field_validator("jobs_database")
    @classmethod
    def _require_database(cls, value: SecretStr) -> SecretStr:
        if value.get_secret_value() and not _is_database(value.get_secret_value()):
            raise ValueError("it must be postgresql://user@host/name, sqlite:////folder/file, or left out")
        return value

    @field_validator("storage_url")
    @classmethod
    def _require_bucket(cls, value: str) -> str:
        if value and not re.fullmatch(r"s3://[A-Za-z0-9._-]+(/[^?#]*)?", value):
            raise ValueError("it must be s3://bucket, s3://bucket/prefix, or left out")
        return value

    @field_validator("storage_endpoint")
    @classmethod
    def _require_address(cls, value: str) -> str:
        if value and not _is_http_address(value):
            raise ValueError("it must be an address such as http://host:port, or left out")
        return value

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,  # noqa: ARG003 - its name is the library's
        file_secret_settings: PydanticBaseSettingsSource,  # noqa: ARG003
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Arguments, then the environment, then the settings file."""
        file = os.environ.get(SETTINGS_FILE_VARIABLE)
        toml = (TomlConfigSettingsSource(settings_cls, Path(file)),) if file else ()
        return (init_settings, env_settings, *toml)

    @property
    def archive_limits(self) -> ArchiveLimits:
        """What the archive of a job may hold."""
        return ArchiveLimits(self.max_job_masks, self.max_body_bytes, self.max_job_bytes)

    @property
    def keys(self) -> tuple[str, ...]:
        """The accepted keys in clear."""
        return tuple(key.get_secret_value() for key in self.api_keys)


def load_settings(overrides: Mapping[str, Any] | None = None) -> Settings:
    """Read the settings.

    Raises:
        InvalidParameter: a value is out of its range, a key is unknown, or the file cannot be read.
    """
    file = os.environ.get(SETTINGS_FILE_VARIABLE)
    unread = InvalidParameter(f"{SETTINGS_FILE_VARIABLE} must name a readable TOML file.", part=SETTINGS_FILE_VARIABLE)
    if file and not Path(file).is_file():
        raise unread
    try:
        return Settings(**(overrides or {}))
    except ValidationError as fault:
        first = fault.errors(include_input=False)[0]
        name = ".".join(map(str, first["loc"])) or "settings"
        reason = first["msg"].removeprefix("Value error, ")
        raise InvalidParameter(f"The setting {name} is not valid: {reason}.", part=name) from None
    except OSError:
        raise unread from None
    except ValueError:
        raise InvalidParameter(f"{SETTINGS_FILE_VARIABLE} must hold valid TOML.", part=SETTINGS_FILE_VARIABLE) from None


def _is_database(url: str) -> bool:
    """Whether an address names a database of a kind that jobs may be kept in."""
    try:
        place = make_url(url)
    except (ArgumentError, ValueError):
        return False
    return place.get_backend_name() in DATABASES and place.database not in (None, "", ":memory:")


def _is_http_address(url: str) -> bool:
    try:
        place = urlsplit(url)
        return place.scheme in ("http", "https") and bool(place.hostname) and place.port != 0
    except ValueError:
        return False


def is_loopback(host: str) -> bool:
    """Whether only programs on the same machine can reach an address."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def require_protection(settings: Settings) -> None:
    """Refuse to listen on a public address without a key.

    Raises:
        InvalidParameter: the address is public, no key is set and nobody allowed that.
    """
    if settings.keys or settings.allow_open or is_loopback(settings.host):
        return
    raise InvalidParameter(
        f"Listening on {settings.host} without a key would open the service to the network: "
        "set MORPHOFLOW_API_KEYS, listen on 127.0.0.1, or allow it with MORPHOFLOW_ALLOW_OPEN=true.",
        part="host",
    )

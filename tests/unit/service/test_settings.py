"""Settings come from arguments, environment and file, in this order, and wrong ones are refused in a sentence."""

import os
from pathlib import Path

import pytest

from model.errors import InvalidParameter
from service.settings import SETTINGS_FILE_VARIABLE, Settings, is_loopback, load_settings, require_protection

#: What no time (s) of the settings may be.
NO_TIMES = ("-1", "0", "nan", "inf", "-inf", "1e300")


@pytest.fixture(autouse=True)
def bare_environment(monkeypatch):
    for name in [name for name in os.environ if name.startswith("MORPHOFLOW_")]:
        monkeypatch.delenv(name)


def settings_file(folder: Path, monkeypatch, text: str) -> None:
    file = folder / "settings.toml"
    file.write_text(text)
    monkeypatch.setenv(SETTINGS_FILE_VARIABLE, str(file))


def test_defaults_listen_on_this_machine_alone():
    settings = load_settings()
    assert is_loopback(settings.host)
    assert settings.keys == ()


def test_environment_overrides_the_file_and_arguments_override_both(tmp_path, monkeypatch):
    settings_file(tmp_path, monkeypatch, "port = 1111\nworkers = 3\nmax_masks = 5\n")
    monkeypatch.setenv("MORPHOFLOW_PORT", "2222")
    monkeypatch.setenv("MORPHOFLOW_WORKERS", "4")
    settings = load_settings({"port": 3333})
    assert (settings.port, settings.workers, settings.max_masks) == (3333, 4, 5)


def test_lists_are_split_as_people_write_them(monkeypatch):
    monkeypatch.setenv("MORPHOFLOW_MODELS", os.pathsep.join(["/a", "/b"]))
    monkeypatch.setenv("MORPHOFLOW_API_KEYS", "one, two,")
    settings = load_settings()
    assert settings.models == (Path("/a"), Path("/b"))
    assert settings.keys == ("one", "two")


def test_lists_in_the_file_are_lists(tmp_path, monkeypatch):
    settings_file(tmp_path, monkeypatch, 'models = ["/a"]\napi_keys = ["one"]\n')
    settings = load_settings()
    assert (settings.models, settings.keys) == ((Path("/a"),), ("one",))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("PORT", "0"),
        ("PORT", "x"),
        ("MAX_BODY_BYTES", "0"),
        ("BACKEND", "y"),
        *[(name, value) for name in ("RESULT_LIFETIME_S", "SWEEP_INTERVAL_S", "JOB_LEASE_S") for value in NO_TIMES],
        ("JOBS_DATABASE", "garbage"),
        ("JOBS_DATABASE", "mysql://user:hush@host/name"),
        ("JOBS_DATABASE", "postgresql://user:hush@host:port/name"),
        ("JOBS_DATABASE", "postgresql://user:hush@host"),
        ("JOBS_DATABASE", "sqlite://"),
        ("JOBS_DATABASE", "sqlite:///:memory:"),
        ("STORAGE_URL", "bucket"),
        ("STORAGE_URL", "s3://"),
        ("STORAGE_URL", "https://bucket.example.org"),
        ("STORAGE_ENDPOINT", "storage:8333"),
        ("STORAGE_ENDPOINT", "http://storage:port"),
    ],
)
def test_a_value_out_of_range_is_named(monkeypatch, name, value):
    monkeypatch.setenv(f"MORPHOFLOW_{name}", value)
    with pytest.raises(InvalidParameter) as caught:
        load_settings()
    assert name.lower() == caught.value.part
    assert "hush" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("jobs_database", "postgresql://user:hush@host:5432/name"),
        ("jobs_database", "postgresql:///name?host=/run/postgresql"),
        ("jobs_database", "sqlite:////folder/file"),
        ("storage_url", "s3://bucket"),
        ("storage_url", "s3://bucket/pre/fix"),
        ("storage_endpoint", "http://storage:8333"),
        ("storage_endpoint", "https://[::1]"),
        ("result_lifetime_s", "3153600000"),
    ],
)
def test_places_and_times_that_can_be_are_accepted(monkeypatch, name, value):
    monkeypatch.setenv(f"MORPHOFLOW_{name.upper()}", value)
    assert name in load_settings().model_fields_set


@pytest.mark.parametrize("text", ["prot = 1\n", "port = \n"])
def test_a_file_that_means_nothing_is_refused(tmp_path, monkeypatch, text):
    settings_file(tmp_path, monkeypatch, text)
    with pytest.raises(InvalidParameter):
        load_settings()


def test_a_file_that_is_not_there_is_refused(monkeypatch):
    monkeypatch.setenv(SETTINGS_FILE_VARIABLE, "/nowhere/settings.toml")
    with pytest.raises(InvalidParameter) as caught:
        load_settings()
    assert "/nowhere" not in str(caught.value)


def test_keys_do_not_show_in_the_settings_as_text():
    assert "hush" not in repr(Settings(api_keys=("hush",)))


@pytest.mark.parametrize(
    ("host", "loopback"),
    [
        ("127.0.0.1", True),
        ("::1", True),
        ("localhost", True),
        ("0.0.0.0", False),
        ("::", False),
        ("192.168.1.4", False),
        ("example.org", False),
    ],
)
def test_loopback(host, loopback):
    assert is_loopback(host) is loopback


@pytest.mark.parametrize(
    "changes", [{}, {"api_keys": ("k",), "host": "0.0.0.0"}, {"allow_open": True, "host": "0.0.0.0"}]
)
def test_protected_services_start(changes):
    require_protection(Settings(**changes))


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "10.0.0.1"])
def test_a_public_address_without_a_key_is_refused(host):
    with pytest.raises(InvalidParameter, match="MORPHOFLOW_API_KEYS"):
        require_protection(Settings(host=host))

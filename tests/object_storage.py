"""S3-compatible storage on this machine: OpenStack Swift, one process of each of its servers, in a folder."""

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from pathlib import Path
from urllib.request import urlopen

import boto3
from botocore.config import Config

from benchmarks.ports import free_ports

BUCKET = "morphoflow"
#: What clients take from the environment.
KEYS = {"AWS_ACCESS_KEY_ID": "test:tester", "AWS_SECRET_ACCESS_KEY": "testing", "AWS_DEFAULT_REGION": "us-east-1"}
_STORES = ("account", "container", "object")
_HASHES = (
    "[swift-hash]\nswift_hash_path_suffix = a\nswift_hash_path_prefix = b\n[storage-policy:0]\nname=one\ndefault=yes\n"
)
_DEFAULT = "[DEFAULT]\nbind_ip = 127.0.0.1\nbind_port = {port}\nworkers = 0\nuser = {user}\nswift_dir = {root}\n"
_STORE = """devices = {root}/devices
mount_check = false
[pipeline:main]
pipeline = {name}-server
[app:{name}-server]
use = egg:swift#{name}
fallocate_reserve = 0
"""
_FILTERS = ("catch_errors", "gatekeeper", "healthcheck", "listing_formats", "bulk", "s3api", "tempauth", "slo", "dlo")


def is_installed() -> bool:
    """Whether Swift is there."""
    return find_spec("swift") is not None


@contextmanager
def object_storage(root: Path) -> Iterator[str]:
    """Address of storage with one empty bucket."""
    ports = dict(zip((*_STORES, "proxy"), free_ports(4), strict=True))
    _configure(root, ports)
    with ExitStack() as stack:
        for name in ports:
            command = [_program(f"swift-{name}-server"), root / f"{name}.conf"]
            server = stack.enter_context(subprocess.Popen([sys.executable, *command], stderr=subprocess.DEVNULL))
            stack.callback(server.terminate)
        address = f"http://127.0.0.1:{ports['proxy']}"
        _await(f"{address}/healthcheck")
        client = boto3.client(
            "s3",
            endpoint_url=address,
            aws_access_key_id=KEYS["AWS_ACCESS_KEY_ID"],
            aws_secret_access_key=KEYS["AWS_SECRET_ACCESS_KEY"],
            region_name=KEYS["AWS_DEFAULT_REGION"],
            config=Config(s3={"addressing_style": "path"}),
        )
        client.create_bucket(Bucket=BUCKET)
        yield address


def _configure(root: Path, ports: dict[str, int]) -> None:
    (root / "devices" / "one").mkdir(parents=True)
    (root / "swift.conf").write_text(_HASHES)
    shared = {"root": root, "user": os.environ.get("USER", "root")}
    for name in _STORES:
        (root / f"{name}.conf").write_text(
            _DEFAULT.format(port=ports[name], **shared) + _STORE.format(name=name, **shared)
        )
        device = f"r1z1-127.0.0.1:{ports[name]}/one"
        for words in (("create", "4", "1", "1"), ("add", device, "1"), ("rebalance",)):
            builder = [sys.executable, _program("swift-ring-builder"), root / f"{name}.builder"]
            subprocess.run([*builder, *words], check=False, stdout=subprocess.DEVNULL)
    filters = "".join(f"[filter:{name}]\nuse = egg:swift#{name}\n" for name in _FILTERS if name != "tempauth")
    pipeline = f"[pipeline:main]\npipeline = {' '.join(_FILTERS)} proxy-server\n"
    users = "[filter:tempauth]\nuse = egg:swift#tempauth\nuser_test_tester = testing .admin\n"
    app = "[app:proxy-server]\nuse = egg:swift#proxy\naccount_autocreate = true\n"
    (root / "proxy.conf").write_text(_DEFAULT.format(port=ports["proxy"], **shared) + pipeline + filters + users + app)


def _program(name: str) -> Path:
    return Path(sys.executable).with_name(name)


def _await(url: str) -> None:
    limit = time.monotonic() + 60.0
    while time.monotonic() < limit:
        try:
            with urlopen(url, timeout=2.0):
                return
        except OSError:
            time.sleep(0.1)
    raise RuntimeError("The storage did not start.")

"""What locust runs: users that send one mask again and again and read its surface.

The environment says how: LOAD_MASK (file), LOAD_RATE (requests a second of each user, 0 for as many as are answered)
and LOAD_UNCERTAINTY.
"""

import os
from pathlib import Path
from types import MappingProxyType

from locust import HttpUser, constant_throughput, task

RATE = float(os.environ.get("LOAD_RATE", "0"))


class Caller(HttpUser):
    """Sends a mask, reads the surface."""

    content = Path(os.environ["LOAD_MASK"]).read_bytes()
    form = MappingProxyType({"uncertainty": os.environ.get("LOAD_UNCERTAINTY", "none")})
    if RATE:
        wait_time = constant_throughput(RATE)

    @task
    def reconstruct(self) -> None:
        """One request."""
        files = {"mask": ("mask.nii.gz", self.content, "application/gzip")}
        self.client.post("/v1/reconstructions", data=dict(self.form), files=files, headers={"Accept": "model/stl"})

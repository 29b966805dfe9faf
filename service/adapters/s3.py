"""Files by key in a bucket of S3-compatible storage."""

import base64
import hashlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, BinaryIO
from urllib.parse import urlsplit

import boto3
from boto3.exceptions import Boto3Error
from botocore.awsrequest import AWSRequest
from botocore.config import Config
from botocore.exceptions import BotoCoreError, ClientError

from model.errors import InvalidParameter
from model.interruption import Check, unchecked

#: Codes that say that an object is not there.
_MISSING = ("404", "NoSuchKey", "NotFound")
#: Objects that one request lists or removes, at most.
_AT_ONCE = 1000
#: Headers of the sums that Content-MD5 stands for.
_NEWER_SUMS = ("x-amz-checksum-", "x-amz-sdk-checksum-")


class S3Blobs:
    """The `BlobStore` in a bucket; keys and region come from the environment, as with every tool for S3.

    Args:
        url: ``s3://bucket`` or ``s3://bucket/prefix``.
        endpoint: address of storage other than Amazon's.

    Raises:
        InvalidParameter: nothing can be asked of storage with what the environment says.
    """

    def __init__(self, url: str, endpoint: str | None) -> None:
        place = urlsplit(url)
        self._bucket = place.netloc
        self._prefix = f"{place.path.strip('/')}/".lstrip("/")
        config = Config(
            retries={"max_attempts": 4, "mode": "standard"},
            connect_timeout=5,
            read_timeout=30,
            s3={"addressing_style": "path"} if endpoint else {},
            request_checksum_calculation="when_required",  # other servers than Amazon's may know no newer ones
            response_checksum_validation="when_required",
        )
        try:
            self._client = boto3.Session().client("s3", endpoint_url=endpoint, config=config)
        except (BotoCoreError, ValueError) as fault:
            raise InvalidParameter(
                "MORPHOFLOW_STORAGE_URL needs a profile and a region that exist (AWS_PROFILE, AWS_DEFAULT_REGION), and "
                "an endpoint that is an address.",
                part="storage_url",
            ) from fault
        self._client.meta.events.register("before-sign.s3.DeleteObjects", _sum_up)

    def put(self, key: str, data: bytes) -> None:
        """Write an object, over an older one."""
        with _as_os_errors():
            self._client.put_object(Bucket=self._bucket, Key=self._prefix + key, Body=data)

    def put_file(self, key: str, file: BinaryIO) -> None:
        """Write a copy of an open file from its beginning, in several pieces when it is large; closes the file."""
        file.seek(0)
        with _as_os_errors():
            self._client.upload_fileobj(file, self._bucket, self._prefix + key)

    def get(self, key: str) -> bytes:
        """Content of an object; `FileNotFoundError` when it is not there."""
        with _as_os_errors():
            content: bytes = self._client.get_object(Bucket=self._bucket, Key=self._prefix + key)["Body"].read()
        return content

    def exists(self, key: str) -> bool:
        """Whether an object is there."""
        try:
            with _as_os_errors():
                self._client.head_object(Bucket=self._bucket, Key=self._prefix + key)
        except FileNotFoundError:
            return False
        return True

    def list(self, prefix: str) -> Iterable[str]:
        """Keys below a folder."""
        for page in self._pages(prefix):
            for item in page.get("Contents", []):
                yield item["Key"].removeprefix(self._prefix)

    def folders(self, prefix: str) -> Iterable[str]:
        """Names of the folders in a folder."""
        place = self._prefix + prefix
        for page in self._pages(prefix, Delimiter="/"):
            for item in page.get("CommonPrefixes", []):
                yield item["Prefix"].removeprefix(place).rstrip("/")

    def delete(self, prefix: str, check: Check = unchecked) -> None:
        """Remove everything below a folder, a page of the bucket's list at a time."""
        for page in self._pages(prefix):
            check()
            if found := page.get("Contents", []):
                self._remove([{"Key": item["Key"]} for item in found])

    def _pages(self, prefix: str, **more: str) -> Iterator[dict[str, Any]]:
        """Pages of the bucket's list below a folder."""
        sizes = {"PageSize": _AT_ONCE}
        with _as_os_errors():
            pages = self._client.get_paginator("list_objects_v2")
            yield from pages.paginate(Bucket=self._bucket, Prefix=self._prefix + prefix, PaginationConfig=sizes, **more)

    def _remove(self, objects: Sequence[dict[str, str]]) -> None:
        """Remove some objects by one request; the answer, not an exception, names those that it did not remove."""
        with _as_os_errors():
            answer = self._client.delete_objects(Bucket=self._bucket, Delete={"Objects": objects, "Quiet": True})
        if any(error.get("Code") not in _MISSING for error in answer.get("Errors", [])):
            raise OSError("The object storage refused to remove some objects.")


def _sum_up(request: AWSRequest, **_: Any) -> None:
    """Give a request the sum that this operation has always had to have; other servers than Amazon's insist on it."""
    for name in [name for name in request.headers if name.lower().startswith(_NEWER_SUMS)]:
        del request.headers[name]
    digest = hashlib.md5(request.body, usedforsecurity=False).digest()
    request.headers["Content-MD5"] = base64.b64encode(digest).decode()


@contextmanager
def _as_os_errors() -> Iterator[None]:
    """Failures of storage as failures of the medium, without addresses or keys."""
    try:
        yield
    except ClientError as error:
        if error.response.get("Error", {}).get("Code") in _MISSING:
            raise FileNotFoundError("The object is not there.") from None
        raise OSError("The object storage refused the request.") from error
    except (BotoCoreError, Boto3Error) as error:
        raise OSError("The object storage does not answer.") from error

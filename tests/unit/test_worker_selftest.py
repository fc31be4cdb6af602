"""The worker's look at the store before it takes jobs: what it must accept, and what it must not."""

from __future__ import annotations

import pytest

from schemas.store import check_store
from workers import selftest


class Bucket:
    """A bucket whose key may write and read and not delete, as workers have it (docs/security.md)."""

    protocol = "s3"

    def __init__(self) -> None:
        self.objects: dict[str, bytes] = {}

    def put_buffer(self, content: bytes, path: str) -> None:
        self.objects[path] = content

    def get_buffer(self, path: str) -> bytes:
        return self.objects[path]

    def remove(self, path: str) -> None:
        raise PermissionError(13, "Access Denied", path)


class Written(Bucket):
    """Somebody's bytes are in the bucket after each write."""

    def __init__(self, content: bytes) -> None:
        super().__init__()
        self.other = content

    def put_buffer(self, content: bytes, path: str) -> None:
        super().put_buffer(self.other, path)


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Bucket:
    found = Bucket()
    monkeypatch.setattr(selftest, "store_backend", lambda: found)
    return found


def test_a_key_that_may_not_delete_is_enough(bucket: Bucket):
    selftest.check([])
    selftest.check([])
    assert len(bucket.objects) == 1  # each start of a worker leaves no further object


def test_workers_that_start_together_may_read_each_others_object(bucket: Bucket):
    check_store(bucket)
    (content,) = bucket.objects.values()
    check_store(Written(content))


@pytest.mark.parametrize("damage", [lambda b: b[:-1], lambda b: b"", lambda b: bytes([b[0] ^ 1]) + b[1:]])
def test_other_bytes_than_were_written_fail_the_test(bucket: Bucket, monkeypatch: pytest.MonkeyPatch, damage):
    check_store(bucket)
    (content,) = bucket.objects.values()
    monkeypatch.setattr(selftest, "store_backend", lambda: Written(damage(content)))
    with pytest.raises(selftest.SelfTestFailed, match="other bytes"):
        selftest.check([])


def test_a_store_that_cannot_be_written_fails_the_test(bucket: Bucket, monkeypatch: pytest.MonkeyPatch):
    def full(content: bytes, path: str) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(bucket, "put_buffer", full)
    with pytest.raises(selftest.SelfTestFailed, match="No space left"):
        selftest.check([])

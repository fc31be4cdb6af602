"""Arrays in an object store: the whole way of `<npy@>` and `<object@>` columns, against a server that speaks S3."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from moto.server import ThreadedMotoServer

import pbl_pipeline.video
import pbl_schemas
from pbl_pipeline.errors import PblError
from pbl_pipeline.tracking import Tracking
from pbl_schemas import connection, store, tracking, video
from pbl_schemas.intake import VisitRecord, ingest
from pbl_schemas.operations import backup, forget
from pbl_schemas.operations.declare import declare_all
from pbl_schemas.stored_files import file_ref, stored_file
from pbl_workers.incoming import import_uploads
from tests import Environment
from tests.rows import remove_all

from . import chain

SECRET = "not-for-anybody-7f3a"


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    """Address of the object store."""
    running = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    running.start()
    host, port = running.get_host_and_port()
    yield f"http://{host}:{port}"
    running.stop()


@pytest.fixture
def remote(
    database: Path, server: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, environment: Environment
) -> Iterator[None]:
    """The store `arrays` is a bucket; key and secret come from files, as containers mount them."""
    (tmp_path / "key").write_text("pbl-worker\n")
    (tmp_path / "secret").write_text(SECRET + "\n")
    pbl_schemas.activate()
    chain.install(monkeypatch)
    environment(
        PBL_S3_ENDPOINT=server,
        PBL_S3_BUCKET="walks",
        PBL_S3_KEY_FILE=tmp_path / "key",
        PBL_S3_SECRET_FILE=tmp_path / "secret",
    )
    connection.connect()
    yield
    monkeypatch.undo()  # also what the test itself set: what follows is for the store in the folder
    connection.connect()
    remove_all()


def test_arrays_and_files_go_to_the_bucket_and_come_back(remote: None, tmp_path: Path):
    backend = connection.store_backend()
    assert backend.protocol == "s3"
    assert not backend.fs.exists("walks")
    store.check_store(backend, create=True)
    path = chain.small_video(tmp_path, "walk")
    ingest([path], VisitRecord(subject="P001"))
    for table in (video.VideoInfo, tracking.Tracking):
        table.populate()
    stored = sorted(backend.fs.find("walks"))
    assert [p.split("/")[1:5] for p in stored] == [
        ["arrays", "_schema", "pbl_tracking", "__tracking"],
        ["arrays", "_schema", "pbl_video", "__video_info"],
        ["arrays", "probe", "written-by-pbl-db-init"],
    ]
    # <npy@>: lazily, with shape and type from the row
    times = video.VideoInfo.fetch1("frame_time")
    assert (times.shape, str(times.dtype)) == ((chain.N_FRAMES,), "float64")
    assert np.asarray(times).tolist() == pbl_pipeline.video.probe(path).time_s.tolist()
    # <object@>: as a file that is gone afterwards
    ref = file_ref(tracking.Tracking.fetch1("tracks"))
    with stored_file(ref) as local:
        found = Tracking.load(local, (1920, 1080), "stand-in", "0" * 64)
    assert not local.exists()
    np.testing.assert_allclose(found.persons[0].box_px, chain.track_people(path).persons[0].box_px, rtol=1e-6)
    # a file that is lost has a code and a next step
    backend.remove(ref["path"])
    with pytest.raises(PblError, match="the object store has no") as error, stored_file(ref):
        pass
    assert error.value.code == "FILE_FORMAT"


def test_a_backup_and_a_person_who_is_forgotten(remote: None, tmp_path: Path):
    declare_all()
    backend = connection.store_backend()
    ingest([chain.small_video(tmp_path, "walk")], VisitRecord(subject="P002"))
    for table in (video.VideoInfo, tracking.Tracking):
        table.populate()
    number = video.Video.fetch1("video_id")
    saved = backup.backup(tmp_path / "backup")
    assert saved.n_files == 2
    assert backup.check(tmp_path / "backup")["n_files"] == 2
    backend.put_buffer(b"x", f"_schema/pbl_keypoints/__keypoints/video_id={number}/left_over.npz")
    # What a bucket keeps unseen: an older version, and the parts of an upload that broke off. Somebody else's stay.
    fs, folder = backend.fs, "arrays/_schema/pbl_keypoints/__keypoints/video_id="
    fs.call_s3("put_bucket_versioning", Bucket="walks", VersioningConfiguration={"Status": "Enabled"})
    for key in (f"{folder}{number}/left_over.npz", f"{folder}{number}9/other.npz"):
        fs.pipe_file(f"walks/{key}", b"a newer one")
        fs.call_s3("create_multipart_upload", Bucket="walks", Key=key)
    done = forget.forget("P002")
    kept = fs.call_s3("list_object_versions", Bucket="walks", Prefix=folder)
    assert [v["Key"] for v in kept["Versions"]] == [f"{folder}{number}9/other.npz"]
    assert not kept.get("DeleteMarkers")
    (upload,) = fs.call_s3("list_multipart_uploads", Bucket="walks")["Uploads"]
    assert upload["Key"] == f"{folder}{number}9/other.npz"
    assert done.left == []
    assert {p.rpartition("/")[2].split("_")[0] for p in done.files} == {"left", "tracks", "frame"}
    assert [p for p in backend.fs.find("walks") if f"video_id={number}/" in p] == []
    # Back into the bucket, from the files alone.
    backup._restore_files(tmp_path / "backup")
    assert len([p for p in backend.fs.find("walks") if f"video_id={number}/" in p]) == 2


def test_phones_may_upload_into_a_bucket(remote: None, tmp_path: Path, environment: Environment):
    fs = connection.store_backend().fs
    if not fs.exists("phones"):
        fs.mkdir("phones")
    content = chain.small_video(tmp_path, "walk", n=5).read_bytes()
    for name in ("P001/1/walk.mp4", "P017/1/walk.mp4", "P001//1/walk.mp4", "P001/1/empty.mp4"):
        fs.pipe_file(f"phones/in/{name}", b"" if "empty" in name else content)
    environment(PBL_INCOMING="s3://phones/in", PBL_ARCHIVE=tmp_path / "archive")
    import_uploads(settled_s=0.0)
    taken = import_uploads(settled_s=0.0)
    assert taken is not None
    first = video.Video.fetch1("video_path")
    assert Path(first).read_bytes() == content
    assert sorted(e.code for e in taken.refused.values()) == ["VIDEO_DUPLICATE", "VIDEO_EMPTY"]
    assert list(taken.ignored) == ["P001/1/walk.mp4"]  # with an empty part in its key: another object
    fs.invalidate_cache()
    assert [p for p in fs.find("phones") if "//" not in p] == []
    # A person who is forgotten leaves nothing there either.
    fs.pipe_file("phones/in/P020/1/walk.mp4", b"not whole yet")
    assert forget.forget("P020", videos=True).left == []
    fs.invalidate_cache()
    assert not fs.find("phones/in/P020")


def test_a_store_that_does_not_answer_is_said_without_the_secret(remote: None, environment: Environment):
    environment(PBL_S3_ENDPOINT="http://127.0.0.1:1", AWS_MAX_ATTEMPTS="1")
    connection.connect()
    with pytest.raises(PblError) as error:
        store.check_store(connection.store_backend())
    assert error.value.code == "STORE_UNAVAILABLE"
    assert "127.0.0.1:1" in str(error.value)
    cause: BaseException | None = error.value
    while cause is not None:
        assert SECRET not in f"{cause!r} {cause}"
        cause = cause.__cause__ or cause.__context__


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"PBL_S3_ENDPOINT": "minio:9000"}, "USAGE"),
        ({"PBL_S3_ENDPOINT": f"http://pbl:{SECRET}@minio:9000"}, "USAGE"),
        ({"PBL_S3_ENDPOINT": "http://minio:9000", "PBL_S3_KEY": "pbl"}, "USAGE"),
        ({"PBL_S3_ENDPOINT": "http://minio:9000", "PBL_S3_SECRET_FILE": "/nowhere"}, "FILE_MISSING"),
    ],
)
def test_settings_that_cannot_work_are_refused(changes: dict[str, str], code: str, environment: Environment):
    environment(**changes)
    with pytest.raises(PblError) as error:
        store.store_spec()
    assert error.value.code == code
    assert SECRET not in str(error.value)

"""The containers of docker-compose.yml as they stand, in a Debian root folder: start-up scripts, user, read-only root,
volumes, secrets, environment.

    apt-get install debootstrap && pytest -m machine tests/integration/test_containers.py

The database is MariaDB with TLS, the store moto's S3 server: MySQL 8.4, MinIO and Docker itself are not tested.
"""

import contextlib
import json
import shutil
import signal
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import boto3
import pytest
from moto.server import ThreadedMotoServer

from pbl_schemas.operations import embedded
from tests import image, until

from . import chain
from .test_secrets import encrypted_server

pytestmark = [
    pytest.mark.machine,
    pytest.mark.database,
    pytest.mark.skipif(
        bool(image.missing()), reason=f"as root, apt-get install debootstrap (missing: {image.missing()})"
    ),
]

#: Who the containers run as.
UID = GID = 1234
#: Where the videos lie in the containers; on this machine they are in the test's folder.
VIDEOS = "/srv/videos"

Compose = Callable[[str], image.Container]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> image.Image:
    """The CPU image."""
    return image.build(tmp_path_factory.mktemp("image"))


@pytest.fixture
def compose(made: image.Image, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Compose]:
    """A service of the compose file, with all that it needs around it."""
    with contextlib.ExitStack() as stack:
        folders = {name: tmp_path / name for name in ("videos", "cache", "home", "backup")}
        for folder in folders.values():
            folder.mkdir(mode=0o700)
            shutil.chown(folder, UID, GID)
        home, _ = stack.enter_context(encrypted_server("db"))
        server = embedded.Folder(home / "db")
        subprocess.run(["sh", image.DOCKERFILE.parent / "make-secrets.sh", tmp_path / "secrets"], check=True)
        (tmp_path / "secrets" / "mysql_root").write_text(server.credentials().admin_password)
        for file in (tmp_path / "secrets").iterdir():
            shutil.chown(file, UID, GID)
        (tmp_path / "hosts").write_text("127.0.0.1 localhost db store\n")
        variables = {
            "PBL_VIDEOS": VIDEOS,
            "PBL_UID": str(UID),
            "PBL_GID": str(GID),
            "PBL_CPU_WORKER": "cpu",
        }
        changes = {"DJ_PORT": str(server.state()["port"]), "PBL_S3_ENDPOINT": stack.enter_context(object_store())}

        def service(name: str) -> image.Container:
            admin = {"DJ_USER": embedded.ADMIN_USER} if name == "roles" else {}
            found = image.service(name, variables)
            volumes = folders | {VIDEOS: folders["videos"]}
            return image.Container(made, found, tmp_path / "secrets", volumes, changes | admin)

        yield service


@contextlib.contextmanager
def object_store() -> Iterator[str]:
    """An S3 server with the bucket that `store-setup` makes; its address."""
    running = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    running.start()
    _, port = running.get_host_and_port()
    login = {"aws_access_key_id": "x", "aws_secret_access_key": "x", "region_name": "us-east-1"}
    boto3.client("s3", endpoint_url=f"http://127.0.0.1:{port}", **login).create_bucket(Bucket="pbl")
    yield f"http://store:{port}"
    running.stop()


def test_the_services_work_as_they_stand(compose: Compose, tmp_path: Path):
    compose("roles").finish()
    compose("migrate").finish()
    incoming = tmp_path / "videos" / "incoming" / "P001" / "2026-03-01"
    incoming.mkdir(parents=True)
    chain.small_video(incoming, "uploaded", 8)
    chain.small_video(tmp_path / "videos", "by-hand", 9)
    subprocess.run(["chown", "-R", f"{UID}:{GID}", tmp_path / "videos"], check=True)

    cron, worker = compose("cron"), compose("worker-cpu")
    loop, working = cron.start(), worker.start()
    try:
        # As docs/deployment.md shows it: docker compose exec cron pbl ingest ...
        ingest = ("pbl", "ingest", f"{VIDEOS}/by-hand.mp4", "--subject", "P002", "--session", "2026-03-01")
        done = cron.execute(*ingest)
        assert done.returncode == 0, done.stdout
        until(lambda: worker.execute(*worker.service["healthcheck"]["test"][1:]).returncode == 0, 180)
        until(lambda: all(subject_chosen(cron, video_id) for video_id in ("1", "2")), 400)
        done = cron.execute("pbl", "cron", "backup")
        assert done.returncode == 0, done.stdout
        assert "2 recordings" in done.stdout
        for process, container in ((working, worker), (loop, cron)):
            process.send_signal(signal.SIGTERM)
            assert process.wait(timeout=int(container.service["stop_grace_period"].removesuffix("s"))) == 0
    finally:
        for process in (loop, working):
            process.kill()
            process.wait()
    # What was imported and saved is its owner's alone.
    (imported,) = (tmp_path / "videos" / "recordings" / "P001").rglob("*.mp4")
    (saved,) = (tmp_path / "backup").glob("*/recordings")
    for path in (imported, *imported.parents[:2], saved.parent, tmp_path / "cache"):
        about = path.stat()
        assert (about.st_uid, about.st_mode & 0o077) == (UID, 0), path
    # A proof that somebody was forgotten outlives the container that wrote it.
    compose("admin").finish(["forget", "P002", "--yes"])
    assert (tmp_path / "home" / "forgotten" / "P002.json").is_file()


def subject_chosen(cron: image.Container, video_id: str) -> bool:
    """Whether the last stage of a video in which nobody is seen has its row."""
    done = cron.execute("pbl", "why", video_id, "--json")
    if done.returncode != 0:
        return False  # not imported yet
    (step,) = (step for step in json.loads(done.stdout)["steps"] if step["table"] == "SubjectChoice")
    return step["what"] in ("done", "empty")

"""The files that bring workers onto machines: valid, without passwords, and calling commands that exist."""

import os
import re
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path
from typing import Any

import click
import pytest
import yaml

from pbl_pipeline import __version__, assets
from pbl_pipeline.cli.command_line import cli
from pbl_workers.supervisor import LAST_S
from tests import Environment
from tests.command import program
from tests.image import sent_to_builder

ROOT = Path(__file__).resolve().parents[2]
DEPLOY = ROOT / "workers" / "deploy"
KUBERNETES = sorted((DEPLOY / "kubernetes").glob("*.yaml"))
SCRIPTS = [*sorted(DEPLOY.rglob("*.sh")), DEPLOY / "slurm" / "worker.sbatch"]
#: Slurm's default KillWait: seconds from the SIGTERM of scancel to SIGKILL.
SLURM_KILL_WAIT_S = 30.0
CRON = ("import", "refresh", "release", "disk", "reprocess", "backup", "summary")


def compose() -> dict[str, Any]:
    return yaml.safe_load((ROOT / "docker-compose.yml").read_text())


def documents(path: Path) -> list[dict[str, Any]]:
    """The objects of a file; those of a list one by one."""
    found = yaml.safe_load_all(path.read_text())
    return [item for d in found for item in (d["items"] if d["kind"] == "List" else [d])]


def workloads() -> list[dict[str, Any]]:
    """The objects of Kubernetes that run containers."""
    return [d for path in KUBERNETES for d in documents(path) if d["kind"] in ("Deployment", "CronJob", "Job")]


# ------------------------------------------------------------------------------------------------------------- compose
def test_the_compose_file_is_what_its_specification_allows():
    check = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", "vendor.compose-spec"]
    done = subprocess.run([*check, ROOT / "docker-compose.yml"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_services_listen_on_this_machine_only_and_have_no_password_of_their_own():
    services = compose()["services"]
    assert set(services) >= {"db", "store", "worker-cpu", "worker-gpu", "cron", "migrate", "roles"}
    for name, service in services.items():
        assert all(str(port).startswith("127.0.0.1:") for port in service.get("ports", [])), name
        assert service["logging"]["options"].keys() == {"max-size", "max-file"}, name
        assert "restart" in service, name
        for variable, value in service.get("environment", {}).items():
            if re.search(r"PASS|SECRET|TOKEN", variable):
                assert variable.endswith("_FILE"), f"{name}: {variable}"
                assert value.startswith("/run/secrets/"), f"{name}: {variable}"
                assert Path(value).name in service["secrets"], f"{name} reads a secret that it does not mount"
    for name in ("db", "store", "worker-cpu", "worker-gpu"):
        assert "healthcheck" in services[name], name
    for name in ("worker-cpu", "worker-gpu", "cron", "migrate", "roles"):
        assert services[name]["cap_drop"] == ["ALL"], name
        assert services[name]["read_only"] is True, name
    # Rights that a service does not need it cannot even look up.
    assert not {"mysql_root", "pbl_owner", "store_root", "store_owner"} & set(services["worker-cpu"]["secrets"])
    assert services["worker-gpu"]["profiles"] == ["gpu"]
    assert services["worker-gpu"]["deploy"]["resources"]["reservations"]["devices"][0]["capabilities"] == ["gpu"]


def test_images_are_named_to_the_last_digit():
    """A tag that moves would change what runs, and a node that has an older image of that name would keep it."""
    images = {service["image"] for service in compose()["services"].values()}
    (base,) = re.findall(r"^ARG PYTHON=(\S+)", (DEPLOY / "Dockerfile").read_text(), re.MULTILINE)
    for name in (*images, f"python:{base}"):
        assert re.search(r":(\d+\.\d+\.\d+|RELEASE\.[\dTZ-]+)(-\w+)*$", name), name
    ours = {f"pbl:{__version__}-cpu", f"pbl:{__version__}-gpu"}
    assert {name for name in images if name.startswith("pbl:")} == ours
    kustomization = documents(DEPLOY / "kubernetes" / "kustomization.yaml")[0]
    assert {f"pbl:{i['newTag']}" for i in kustomization["images"]} == ours


def test_registered_models_proofs_and_backups_outlive_a_container():
    for name, service in compose()["services"].items():
        if service["image"].startswith("pbl:"):
            assert "home:/var/lib/pbl" in service["volumes"], name
            assert not [entry for entry in service["tmpfs"] if "/var/lib" in entry], name
    assert any(entry.endswith(":/var/backups/pbl") for entry in compose()["services"]["cron"]["volumes"])
    for document in workloads():
        (home,) = (v for v in pod(document)["volumes"] if v["name"] == "home")
        assert home["persistentVolumeClaim"] == {"claimName": "home"}, document["metadata"]["name"]


def test_the_builder_gets_what_the_image_takes_and_every_package_has_a_hash():
    text = (DEPLOY / "Dockerfile").read_text().replace("${FLAVOUR}", "cpu")
    copied = [word for line in re.findall(r"^COPY (?!--from)(.*)$", text, re.MULTILINE) for word in line.split()[:-1]]
    assert "hatch_build.py" in copied
    for source in copied:
        assert source.startswith("--") or (sent_to_builder(source) and (ROOT / source).exists()), source
    # Whatever pip fetches comes from a lock file with hashes; what builds our wheel as well.
    for line in re.findall(r"pip (?:install|wheel) .*", text):
        assert "--require-hashes" in line or "--no-deps --no-index" in line or "--no-build-isolation" in line, line
    build = tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]["requires"]
    lock = (DEPLOY / "requirements-build.lock").read_text()
    for requirement in build:
        assert re.search(rf"^{re.split('[<>=]', requirement)[0]}==\S+ \\\n    --hash=sha256:", lock, re.MULTILINE)


def test_no_lock_repeats_what_the_lock_of_the_image_has():
    image = DEPLOY / "requirements-cpu.lock"
    for lock in (DEPLOY / "requirements-gpu.lock", ROOT / "requirements.lock"):
        first, *others = lock.read_text().splitlines()
        assert (lock.parent / first.removeprefix("-r ")).resolve() == image.resolve()
        packages, of_image = (
            {line.partition("==")[0] for line in lines if "==" in line and not line.startswith((" ", "#"))}
            for lines in (others, image.read_text().splitlines())
        )
        assert packages
        assert not packages & of_image
        assert {"s3fs", "matplotlib", "lzfse"} <= of_image  # the extras of what workers do


def test_a_worker_has_longer_to_end_than_it_takes():
    grace: Any = next(p for p in command(["worker"]).params if p.name == "grace_s").default
    for name in ("worker-cpu", "cron"):  # Docker's own 10 s are too short for an import
        assert int(compose()["services"][name]["stop_grace_period"].removesuffix("s")) > grace
    for name in ("worker-cpu", "worker-gpu"):
        (deployment,) = documents(DEPLOY / "kubernetes" / f"{name}.yaml")
        assert deployment["spec"]["template"]["spec"]["terminationGracePeriodSeconds"] > grace
    unit = (DEPLOY / "systemd" / "pbl-worker@.service").read_text()
    assert int(re.search(r"TimeoutStopSec=(\d+)", unit).group(1)) > grace  # type: ignore[union-attr]


def test_every_secret_is_made_by_the_script(tmp_path: Path):
    folder = tmp_path / "secrets"
    for _ in range(2):
        subprocess.run(["sh", DEPLOY / "make-secrets.sh", folder], check=True)
        made = {p.name: p.read_text() for p in folder.iterdir()}
        assert made.keys() == compose()["secrets"].keys()
        assert len(set(made.values())) == len(made)
        assert all(re.fullmatch("[0-9a-f]{48}", text) for text in made.values())
        assert {p.stat().st_mode & 0o777 for p in folder.iterdir()} == {0o600}
    (folder / "pbl_worker").write_text("my own")
    subprocess.run(["sh", DEPLOY / "make-secrets.sh", folder], check=True)
    assert (folder / "pbl_worker").read_text() == "my own"
    assert "/secrets/" in (ROOT / ".gitignore").read_text()


# ------------------------------------------------------------------------------------------------- commands that exist
def command(words: list[str]) -> click.Command:
    """The command that a call of pbl names, its options checked; fails where there is none."""
    context, found = click.Context(cli), cli
    rest = [w for w in words if w != "--quiet"]
    while isinstance(found, click.Group):
        name = rest.pop(0)
        below = found.get_command(context, name)
        assert below is not None, f"pbl has no {name} ({' '.join(words)})"
        found = below
    known = {o for p in found.params for o in p.opts}
    assert not [w for w in rest if w.startswith("--") and w not in known], words
    return found


def calls() -> list[list[str]]:
    """Every call of pbl in the files of the deployment."""
    out = []
    for service in compose()["services"].values():
        if service["image"].startswith("pbl:") and "command" in service:
            out.append([str(w) for w in service["command"]])
    for path in KUBERNETES:
        for document in documents(path):
            text = str(document)
            out += [re.findall(r"'([^']*)'", args) for args in re.findall(r"'args': \[([^\]]*)\]", text)]
    for path in (
        DEPLOY / "crontab",
        *sorted((DEPLOY / "systemd").glob("*.service")),
        DEPLOY / "slurm" / "worker.sbatch",
    ):
        for line in path.read_text().splitlines():
            match = re.search(r"(?:^|[ /])pbl\"? ((?:--quiet )?(?:worker|cron) .*)$", line)
            if match and not line.startswith("#"):
                words = match.group(1).replace('"', "").removesuffix(" &").split()
                # the unit of systemd stands for all of its instances
                out += [[w.replace("%i", job) for w in words] for job in (CRON if "cron" in words else ("cpu",))][:99]
    return out


def test_all_files_call_commands_and_options_that_exist():
    found = calls()
    assert len(found) > 20
    for words in found:
        command(words)
    assert {w[w.index("cron") + 1] for w in found if "cron" in w} == set(CRON)


def test_the_loop_and_the_timers_run_every_cron_job():
    loop = (DEPLOY / "cron-loop.sh").read_text()
    assert set(re.findall(r"&& run (\w+)$", loop, re.MULTILINE)) == set(CRON)
    timers = {p.name.split("@")[1].removesuffix(".timer") for p in (DEPLOY / "systemd").glob("*.timer")}
    assert timers == set(CRON)
    jobs = {d["metadata"]["name"].removeprefix("cron-") for d in documents(DEPLOY / "kubernetes" / "cron.yaml")}
    assert jobs == set(CRON)


# ------------------------------------------------------------------------------------------------------------- scripts
@pytest.mark.parametrize("script", SCRIPTS, ids=lambda p: p.name)
def test_scripts_have_no_fault_that_shellcheck_knows(script: Path):
    linter = Path(sys.executable).with_name("shellcheck")
    done = subprocess.run([linter, script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


def test_the_entrypoint_seeds_an_empty_cache_and_runs_pbl(tmp_path: Path):
    seed, cache = tmp_path / "seed", tmp_path / "cache"
    (seed / "assets").mkdir(parents=True)
    (seed / "assets" / "model.tflite").write_text("model")
    (seed / "assets" / "other").write_text("new")
    (cache / "assets").mkdir(parents=True)
    (cache / "assets" / "other").write_text("there already")
    program(tmp_path, "pbl", 'echo "pbl $*"\nexit 7\n')
    environment = {"PATH": f"{tmp_path}:/usr/bin:/bin", "PBL_SEED": str(seed), "PBL_CACHE": str(cache)}
    start = ["sh", str(DEPLOY / "entrypoint.sh"), "worker", "--resource", "a b"]
    done = subprocess.run(start, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (7, "pbl worker --resource a b\n"), done.stderr
    found = {p.name: p.read_text() for p in cache.rglob("*") if p.is_file()}
    assert found == {"model.tflite": "model", "other": "there already"}


@pytest.mark.skipif(os.name != "posix" or os.geteuid() != 0, reason="only root can become another user")
@pytest.mark.parametrize("user", ["1000:1000", "10001:10001", "1234:5678"])
def test_the_image_starts_as_any_user(user: str, monkeypatch: pytest.MonkeyPatch, environment: Environment):
    """The models lie in the image with the rights that root's build leaves, locks included."""
    with tempfile.TemporaryDirectory(dir="/tmp") as name:  # pytest's own folders are closed to others
        folder, before = Path(name), os.umask(0o022)
        folder.chmod(0o755)
        try:
            environment(PBL_CACHE=folder / "seed")
            monkeypatch.setattr(assets, "_bring", lambda asset: asset.path.write_text("model"))
            monkeypatch.setattr(assets, "_is_pinned", lambda path, sha256: path.is_file())
            model = assets.fetch("blazepose_detector").name
            (folder / "seed/assets/.lock").touch()
            volume = folder / "volume"
            volume.mkdir()
            volume.chmod(0o1777)
            script = folder / "entrypoint.sh"
            script.write_bytes((DEPLOY / "entrypoint.sh").read_bytes())
            program(folder, "pbl", 'cat "$PBL_CACHE/assets/"*\n')
        finally:
            os.umask(before)
        given = {"PATH": f"{name}:/usr/bin:/bin", "PBL_SEED": f"{name}/seed", "PBL_CACHE": str(volume)}
        uid, gid = user.split(":")
        start = ["setpriv", f"--reuid={uid}", f"--regid={gid}", "--clear-groups", "sh", str(script)]
        for _ in range(2):  # and again
            done = subprocess.run(start, env=given, capture_output=True, text=True, check=False)
            assert (done.returncode, done.stdout, done.stderr) == (0, "model", "")
        assert [p.name for p in volume.rglob("*") if p.is_file()] == [model]
        (folder / "seed/assets/another").write_text("x")
        (folder / "seed/assets/another").chmod(0o600)
        done = subprocess.run(start, env=given, capture_output=True, text=True, check=False)
        assert done.returncode == 1
        assert "ASSET_MISSING: " in done.stderr
        assert "  next: " in done.stderr
        assert [p.name for p in volume.rglob("*") if p.is_file()] == [model]


def test_the_cron_loop_goes_by_the_clock_and_on_after_a_job_that_fails(tmp_path: Path):
    program(tmp_path, "pbl", f'echo "$3" >> {tmp_path}/ran\n[ "$3" != import ]\n')
    # Each look at the clock is a quarter of an hour later; the first is 01:55 of some day.
    program(
        tmp_path,
        "date",
        f"echo x >> {tmp_path}/looks\necho $((86400 * 20000 + 6000 + 900 * $(wc -l < {tmp_path}/looks)))\n",
    )
    environment = {"PATH": f"{tmp_path}:/usr/bin:/bin", "PBL_CRON_TICK_S": "0.02"}
    loop = subprocess.Popen(["sh", DEPLOY / "cron-loop.sh"], env=environment, stderr=subprocess.PIPE, text=True)
    ran = tmp_path / "ran"
    deadline = time.monotonic() + 120
    while not (ran.exists() and "summary" in ran.read_text()) and time.monotonic() < deadline:
        time.sleep(0.05)
    loop.send_signal(signal.SIGTERM)
    _, said = loop.communicate(timeout=120)
    assert loop.returncode == 0
    names = ran.read_text().split()
    upto = names[: names.index("summary") + 1]
    assert [n for n in upto if n in ("reprocess", "backup", "summary")] == ["reprocess", "backup", "summary"]
    assert upto.count("import") == upto.count("refresh") == upto.count("release") == 9  # 02:10 to 04:10
    assert upto.count("disk") == 2
    assert "pbl cron import failed with code 1" in said
    assert ran.stat().st_mode & 0o077 == 0


def test_the_slurm_script_ends_its_worker_in_order(tmp_path: Path):
    (tmp_path / "bin").mkdir()
    worker = "trap 'sleep 0.3; echo ended; exit 5' TERM\necho \"$DJ_HOST $*\"\nwhile :; do sleep 0.05; done\n"
    program(tmp_path / "bin", "pbl", worker)
    settings = tmp_path / "worker.env"
    settings.write_text("DJ_HOST=db.example\n")
    environment = {"PATH": "/usr/bin:/bin", "HOME": str(tmp_path), "PBL_VENV": str(tmp_path), "PBL_RESOURCE": "gpu"}
    start = ["bash", DEPLOY / "slurm" / "worker.sbatch"]
    missing = subprocess.run(start, env=environment, capture_output=True, text=True, check=False)
    assert missing.returncode == 2
    assert "PBL_SETTINGS" in missing.stderr
    environment["PBL_SETTINGS"] = str(settings)
    job = subprocess.Popen(start, env=environment, stdout=subprocess.PIPE, text=True)
    assert job.stdout is not None
    host, *words = job.stdout.readline().split()
    assert (host, words[:-1]) == (
        "db.example",
        ["worker", "--resource", "gpu", "--processes", "auto", "--no-phones", "--grace"],
    )
    assert float(words[-1]) + LAST_S < SLURM_KILL_WAIT_S
    job.send_signal(signal.SIGTERM)
    said, _ = job.communicate(timeout=120)
    assert said == "ended\n"
    assert job.returncode == 5


# ---------------------------------------------------------------------------------------------------------- kubernetes
def pod(document: dict[str, Any]) -> dict[str, Any]:
    """The pod of a Deployment, Job or CronJob."""
    spec = document["spec"]
    return spec.get("jobTemplate", {"spec": spec})["spec"]["template"]["spec"]


def test_pods_run_as_nobody_special_and_read_secrets_from_files():
    for document in workloads():
        spec = pod(document)
        assert spec["securityContext"]["runAsNonRoot"] is True
        assert spec["automountServiceAccountToken"] is False
        (container,) = spec["containers"]
        assert container["securityContext"]["readOnlyRootFilesystem"] is True
        assert {"requests", "limits"} <= container["resources"].keys()
        assert {m["name"] for m in container["volumeMounts"]} == {v["name"] for v in spec["volumes"]}
        wanted = {e["value"] for e in container.get("env", []) if e["name"].endswith("_FILE")}
        secret = next(v["secret"] for v in spec["volumes"] if v["name"] == "secrets")
        mounted = {f"/run/secrets/pbl/{item['path']}" for item in secret["items"]}
        assert wanted <= mounted
        if document["kind"] != "Job":
            assert not any("owner" in m for m in mounted)
    assert len(workloads()) == 10
    assert not [d for p in KUBERNETES for d in documents(p) if d["kind"] == "Secret"]
    kustomization = documents(DEPLOY / "kubernetes" / "kustomization.yaml")[0]
    assert {p.name for p in KUBERNETES} == {"kustomization.yaml", *kustomization["resources"]}


def test_manifests_are_what_their_schemas_allow():
    validate = pytest.importorskip("kubernetes_validate", reason="pip install kubernetes-validate (100 MB)")
    for path in KUBERNETES:
        for document in documents(path):
            if not document["apiVersion"].startswith(("keda.sh", "kustomize")):
                validate.validate(document, "1.30", strict=True)


def test_the_number_of_workers_follows_every_queue():
    """The query names the queue of each table that the worker serves (the tables are tested with a database)."""
    from pbl_schemas.chain import tables
    from pbl_workers.registry import GROUPS, STAGES

    queries = {
        d["metadata"]["name"]: d["spec"]["triggers"][0]["metadata"]["query"]
        for d in documents(DEPLOY / "kubernetes" / "scale.yaml")
        if d["kind"] == "ScaledObject"
    }
    for group in ("cpu", "gpu"):
        served = {name for name, s in STAGES.items() if s.resource in GROUPS[group]}
        wanted = {
            f"pbl_{module}.`~~{_snake(name)}`" for module, name in (n.split(".", 1) for n in tables()) if name in served
        }
        assert set(re.findall(r"FROM (\S+) WHERE", queries[f"worker-{group}"])) == wanted


def _snake(name: str) -> str:
    return re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower()

#!/usr/bin/env bash
# Upgrading mujoco 3 to 4 with pip leaves an installation that cannot be imported.
#
# Seen 2026-11-28: pip 26.3 (also 23.2.1), mujoco 3.17.0 upgraded to 4.0.0, which is split into mujoco, mujoco-core and mujoco-studio.
# Behaviour: pip installs mujoco-core first and removes the old mujoco afterwards, with the files that both own. pip
#   reports success and `pip check` finds nothing.
# Matters: an environment of an older release that is upgraded in place fails at its first import. A new environment
#   is not affected. Remedy: reinstall mujoco-core.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install pip==26.3 mujoco==3.17.0
observe venv <<'PY'
import subprocess, sys

def pip(*words):
    return subprocess.run([sys.executable, "-m", "pip", *words], capture_output=True, text=True)

def imported():
    code = (
        "try:\n import mujoco; print('imports', mujoco.__version__)\n"
        "except ImportError as e:\n print(type(e).__name__, 'from', repr(e.__cause__))\n"
    )
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip()

print("3.17.0:", imported())
done = pip("install", "--quiet", "--only-binary", ":all:", "mujoco==4.0.0")
if done.returncode:
    print("pip could not install mujoco 4.0.0", file=sys.stderr)
    sys.exit(75)
print("upgrade: exit", done.returncode, "| pip check: exit", pip("check").returncode)
print("4.0.0 after the upgrade:", imported())
pip("install", "--quiet", "--force-reinstall", "--no-deps", "mujoco-core==4.0.0")
print("mujoco-core reinstalled:", imported())
PY
expect <<'SEEN'
3.17.0: imports 3.17.0
upgrade: exit 0 | pip check: exit 0
4.0.0 after the upgrade: ImportError from ModuleNotFoundError("No module named 'mujoco._specs'")
mujoco-core reinstalled: imports 4.0.0
SEEN

#!/usr/bin/env bash
# Creates the virtual environment and installs the project, with what serving needs (`setup.sh serving`, the default) or
# with training, tests and documentation too (`setup.sh everything`).
# Settings: PYTHON (default python3), VENV (default .venv), TORCH_INDEX (see scripts/install_torch.py).
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

python="${PYTHON:-python3}"
venv="${VENV:-.venv}"
# serving.lock is for these extras, requirements.lock for those below: `make lock`.
serving="service,plans,ocr,client,mcp"
everything="train,service,ray,oracle,plans,ifc,ocr,docs,dev"
is_recent='import sys; sys.exit(sys.version_info < (3, 11))'

fail() {
    printf 'setup: %s\n' "$*" >&2
    exit 1
}

check_python() {
    command -v "$python" >/dev/null || fail "no '$python' here; install Python 3.11 or later, or say: make PYTHON=..."
    "$python" -c "$is_recent" ||
        fail "'$python' is $("$python" --version 2>/dev/null || echo unusable); Python 3.11 or later is needed; say for instance: make PYTHON=python3.12"
}

# An environment that works is kept, so that a change of pyproject.toml does not download everything again.
create_venv() {
    if [ -x "$venv/bin/python" ] && "$venv/bin/python" -c "$is_recent" 2>/dev/null &&
        "$venv/bin/python" -m pip --version >/dev/null 2>&1; then
        return
    fi
    check_python
    "$python" -m venv --clear "$venv" ||
        fail "'$python' cannot create virtual environments; on Debian and Ubuntu the package is python3-venv"
}

case "${1:-serving}" in
serving)
    extras="$serving" lock=serving.lock
    printf 'Installing LaLaLoc into %s: 0.7 GB, about a minute. Training and tests come with `make develop`.\n' "$venv"
    printf 'Meanwhile, docs/getting-started.md leads from a plan to an answer.\n'
    ;;
everything)
    extras="$everything" lock=requirements.lock
    printf 'Installing LaLaLoc into %s, with training, tests and documentation: 2.8 GB. See CONTRIBUTING.md.\n' "$venv"
    ;;
*) fail "'$1' is neither 'serving' nor 'everything'" ;;
esac
create_venv
# Without compiled files, which Python writes itself for the few modules that are imported.
export PIP_NO_COMPILE=1 PIP_DISABLE_PIP_VERSION_CHECK=1
torch=
if [ "$lock" = requirements.lock ]; then
    # Torch comes while the others do.
    "$venv/bin/python" scripts/install_torch.py &
    torch=$!
fi
"$venv/bin/python" scripts/install_lock.py "$lock"
[ -z "$torch" ] || wait "$torch"
"$venv/bin/uv" pip install -q --python "$venv/bin/python" --no-deps --no-build-isolation -e ".[$extras]"
printf 'Installed: %s/bin/lalaloc --help\n' "$venv"

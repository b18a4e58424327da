"""Tests of installation, image and Kubernetes manifests: they agree with each other and with the service."""

from __future__ import annotations

import ipaddress
import re
import subprocess
import sys
import tomllib
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml
from fastapi.routing import APIRoute
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from lalaloc_core import __version__
from scripts import install_torch
from scripts.write_locks import extras_of
from service.capacity.admission_control import Admission
from service.capacity.cores import share_cores
from service.routes import ROUTERS
from service.settings import PREFIX, SETTING_NAMES, Settings, settings_table
from service.telemetry import Telemetry

ROOT = Path(__file__).parents[1]
DOCKERFILE = (ROOT / "docker" / "Dockerfile").read_text(encoding="utf-8")
REPLICAS = yaml.safe_load((ROOT / "docker" / "compose.replicas.yaml").read_text(encoding="utf-8"))["services"]
COMPOSE = yaml.safe_load((ROOT / "docker" / "compose.yaml").read_text(encoding="utf-8"))["services"]["service"]
PYPROJECT = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
SETTINGS = {PREFIX + name.upper() for name in SETTING_NAMES}
OVERLAYS = ("replicas", "single")
# Oldest supported and newest version at the time of writing.
VERSIONS = ("1.34", "1.37")


def _rendered(overlay: str) -> dict[str, dict[str, Any]]:
    """Return the manifests of an overlay by kind, as `kubectl apply -k` applies them."""
    kubectl = Path(sys.executable).with_name("kubectl")
    folder = ROOT / "docker" / "kubernetes" / overlay
    done = subprocess.run([kubectl, "kustomize", folder], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    manifests = list(yaml.safe_load_all(done.stdout))
    by_kind = {manifest["kind"]: manifest for manifest in manifests}
    assert len(by_kind) == len(manifests)
    return by_kind


RENDERED = {overlay: _rendered(overlay) for overlay in OVERLAYS}
BY_KIND = RENDERED["replicas"]
POD: dict[str, Any] = BY_KIND["Deployment"]["spec"]["template"]["spec"]
CONTAINER: dict[str, Any] = POD["containers"][0]
LABELS: dict[str, str] = BY_KIND["Deployment"]["spec"]["template"]["metadata"]["labels"]
CONFIGURED: dict[str, str] = BY_KIND["ConfigMap"]["data"]


def pinned_versions() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = [line.split("==") for line in lines if line and not line.startswith("#")]
    return {canonicalize_name(name): version for name, version in pins}


def _copied() -> list[str]:
    """Return the sources of the image that come from the repository."""
    copies = re.findall(r"^COPY (?!--from)(.+) \S+$", DOCKERFILE, re.MULTILINE)
    return [source for copy in copies for source in copy.split()]


def test_direct_requirements_are_pinned_once() -> None:
    project = tomllib.loads(PYPROJECT)["project"]
    groups = [project["dependencies"], *project["optional-dependencies"].values()]
    requirements = [Requirement(text) for group in groups for text in group]
    pins = pinned_versions()
    own = {"lalaloc", "torch"}
    for requirement in requirements:
        name = canonicalize_name(requirement.name)
        assert name in own or requirement.specifier.contains(pins[name]), requirement
    # Its build depends on the machine.
    assert "torch" not in pins
    assert re.fullmatch(r"\d+\.\d+\.\d+", install_torch.pinned_version(PYPROJECT))


@pytest.mark.parametrize(
    ("gpu", "found", "strict", "expected"),
    [
        (False, {"2.0.0+cpu locked"}, "", ["2.0.0+cpu locked"]),
        (False, {"2.0.0+cpu"}, "", ["2.0.0+cpu locked", "2.0.0+cpu"]),
        (False, {"2.0.0"}, "", ["2.0.0+cpu locked", "2.0.0+cpu", "2.0.0"]),
        (False, {"2.0.0+cpu"}, "1", ["2.0.0+cpu locked"]),
        (True, {"2.0.0"}, "", ["2.0.0"]),
    ],
)
def test_cpu_build_is_tried_first_without_a_gpu(
    monkeypatch: pytest.MonkeyPatch, gpu: bool, found: set[str], strict: str, expected: list[str]
) -> None:
    tried = []

    def pip_install(requirement: str, *, locked: bool = False) -> int:
        tried.append(requirement.removeprefix("torch==") + " locked" * locked)
        return 0 if tried[-1] in found else 1

    monkeypatch.setenv("TORCH_LOCKED", strict)
    monkeypatch.setattr(install_torch.sys, "platform", "linux")
    monkeypatch.setattr(install_torch, "has_gpu", lambda: gpu)
    monkeypatch.setattr(install_torch, "is_installed", lambda version, wants_cpu: False)
    monkeypatch.setattr(install_torch, "pinned_version", lambda pyproject: "2.0.0")
    monkeypatch.setattr(install_torch, "pip_install", pip_install)
    assert (install_torch.main() == 0) == (tried[-1] in found)
    assert tried == expected


@pytest.mark.parametrize(
    ("installed", "wants_cpu", "right"),
    [
        ("2.0.0+cpu", True, True),
        ("2.0.0", True, True),
        ("2.0.0+cpu", False, False),
        ("2.0.0", False, True),
        ("1.9.0", True, False),
    ],
)
def test_right_installed_torch_is_kept(
    monkeypatch: pytest.MonkeyPatch, installed: str, wants_cpu: bool, right: bool
) -> None:
    monkeypatch.setattr(install_torch.importlib.metadata, "version", lambda name: installed)
    assert install_torch.is_installed("2.0.0", wants_cpu=wants_cpu) is right


def test_image_copies_existing_files_and_can_export_spans() -> None:
    sources = _copied()
    assert sources
    assert [source for source in sources if not (ROOT / source).exists()] == []
    lines = (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    let_through = [line[1:] for line in lines if line.startswith("!")]
    assert "*" in lines
    assert [source for source in sources if not any(fnmatch(source.rstrip("/"), name) for name in let_through)] == []
    assert {"service", "lpo", "otel"} <= set(extras_of("docker/requirements.lock"))


def test_image_and_compose_use_known_settings() -> None:
    named = set(re.findall(r"\bLALALOC_[A-Z_]+", DOCKERFILE)) | set(COMPOSE["environment"])
    assert named - {"FORWARDED_ALLOW_IPS"} <= SETTINGS
    folders = dict(re.findall(r"\b(LALALOC_[A-Z_]+)=(\S+)", DOCKERFILE))
    assert SETTINGS - COMPOSE["environment"].keys() == folders.keys()
    assert [name for name, path in folders.items() if not re.search(f"`{name}`.*`{path}`", settings_table())] == []
    (port,) = re.findall(r"^EXPOSE (\d+)$", DOCKERFILE, re.MULTILINE)
    assert f'"--port", "{port}"' in DOCKERFILE
    assert f"http://127.0.0.1:{port}/readyz" in DOCKERFILE
    assert [published.split(":")[-1] for published in COMPOSE["ports"]] == [port]


def test_compose_publishes_locally_by_default() -> None:
    environment, (published,) = COMPOSE["environment"], COMPOSE["ports"]
    assert published == f"{environment['LALALOC_PUBLISHED_ON'].removesuffix(':8000}')}:8000}}:8000"
    assert environment["LALALOC_PUBLISHED_ON"].startswith("${LALALOC_PUBLISH:-127.0.0.1:")
    assert environment["LALALOC_ALLOW_ANONYMOUS"] == "${LALALOC_ALLOW_ANONYMOUS:-off}"


def test_proxy_and_replicas_match() -> None:
    replicas = {name: service for name, service in REPLICAS.items() if name.startswith("replica-")}
    proxy = (ROOT / "docker" / "nginx.conf").read_text(encoding="utf-8")
    (port,) = re.findall(r"^EXPOSE (\d+)$", DOCKERFILE, re.MULTILINE)
    assert set(re.findall(r"^ *server (\S+):(\d+)", proxy, re.MULTILINE)) == {(name, port) for name in replicas}
    (listens,) = re.findall(r"listen (\d+);", proxy)
    assert [published.split(":")[-1] for published in REPLICAS["proxy"]["ports"]] == [listens]
    for service in replicas.values():
        assert {name for name in service["environment"] if name.startswith("LALALOC_")} <= SETTINGS
        without_keys = {"LALALOC_PUBLISHED_ON", "LALALOC_ALLOW_ANONYMOUS", "LALALOC_ALLOWED_HOSTS"}
        assert COMPOSE["environment"].keys() - service["environment"].keys() == without_keys
        assert service["build"] == COMPOSE["build"]
        assert service["environment"]["LALALOC_API_KEYS"] == "on"


def test_containers_and_pods_have_time_to_stop() -> None:
    for service in (COMPOSE, REPLICAS["replica-1"]):
        assert float(service["stop_grace_period"].rstrip("s")) > Settings().requests.stop_deadline_s
    notice_s, deadline_s = float(CONFIGURED["LALALOC_STOP_NOTICE_S"]), Settings().requests.stop_deadline_s
    assert POD["terminationGracePeriodSeconds"] > notice_s + deadline_s
    probe = CONTAINER["readinessProbe"]
    assert notice_s > probe["periodSeconds"] * probe["failureThreshold"]


def test_image_does_not_run_as_root() -> None:
    final_stage = DOCKERFILE[DOCKERFILE.rindex("\nFROM ") :]
    assert re.search(r"^USER (?!root)\w+$", final_stage, re.MULTILINE)
    build = COMPOSE["build"]
    context = ROOT / "docker" / build["context"]
    assert (context / build["dockerfile"]).read_text(encoding="utf-8") == DOCKERFILE
    assert f"AS {build['target']}\n" in final_stage


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("overlay", OVERLAYS)
def test_manifests_are_valid(overlay: str, version: str) -> None:
    for manifest in RENDERED[overlay].values():
        assert kubernetes_validate.validate(manifest, version, strict=True) == version


def test_every_manifest_is_applied() -> None:
    folder = ROOT / "docker" / "kubernetes"
    for part in folder.rglob("*.yaml"):
        if part.name == "kustomization.yaml" or part.name == "prometheus-adapter.yaml":
            continue
        kustomization = yaml.safe_load(part.with_name("kustomization.yaml").read_text(encoding="utf-8"))
        patches = [patch["path"] for patch in kustomization.get("patches", [])]
        assert part.name in [*kustomization["resources"], *patches], part
    for rendered in RENDERED.values():
        image = rendered["Deployment"]["spec"]["template"]["spec"]["containers"][0]["image"]
        assert image == COMPOSE["image"] == f"lalaloc:{__version__}"


def test_single_pod_keeps_its_data() -> None:
    """SQLite has one writer: no second pod at any time, and a volume that outlives the pod."""
    single = RENDERED["single"]
    spec = single["Deployment"]["spec"]
    assert (spec["replicas"], spec["strategy"]) == (1, {"type": "Recreate"})
    assert "HorizontalPodAutoscaler" not in single
    pod = spec["template"]["spec"]
    [data] = [volume for volume in pod["volumes"] if volume["name"] == "data"]
    claim = single["PersistentVolumeClaim"]["metadata"]["name"]
    assert data == {"name": "data", "persistentVolumeClaim": {"claimName": claim}}
    assert "env" not in pod["containers"][0]
    assert single["ConfigMap"] == BY_KIND["ConfigMap"]


def test_proxies_are_trusted_by_address() -> None:
    """No deployment trusts X-Forwarded-For of everybody, and pods admit their proxy by namespace and name."""
    assert ipaddress.ip_network(CONFIGURED["FORWARDED_ALLOW_IPS"]).prefixlen >= 8
    for rule in BY_KIND["NetworkPolicy"]["spec"]["ingress"]:
        for peer in rule["from"]:
            assert peer["namespaceSelector"]["matchLabels"].keys() == {"kubernetes.io/metadata.name"}
            assert peer["podSelector"]["matchLabels"]
    tls = yaml.safe_load((ROOT / "docker" / "compose.tls.yaml").read_text(encoding="utf-8"))
    replicas = yaml.safe_load((ROOT / "docker" / "compose.replicas.yaml").read_text(encoding="utf-8"))
    for compose, behind in ((tls, "service"), (replicas, "replica-1")):
        services = compose["services"]
        address = services["proxy"]["networks"]["front"]["ipv4_address"]
        assert services[behind]["environment"]["FORWARDED_ALLOW_IPS"] == address
        [subnet] = compose["networks"]["front"]["ipam"]["config"]
        assert ipaddress.ip_address(address) in ipaddress.ip_network(subnet["subnet"])
    assert replicas["networks"]["database"] == {"internal": True}
    assert replicas["services"]["database"]["networks"] == ["database"]


@pytest.mark.parametrize("name", ["compose.yaml", "compose.replicas.yaml", "compose.tls.yaml"])
def test_compose_files_are_valid_and_bounded(name: str) -> None:
    file = ROOT / "docker" / name
    check_schema("vendor.compose-spec", file)
    for service in yaml.safe_load(file.read_text(encoding="utf-8"))["services"].values():
        # An override leaves the rest to the file that it extends.
        if "image" not in service:
            continue
        assert {"mem_limit", "pids_limit"} <= service.keys()
        assert service["read_only"]
        assert service["cap_drop"] == ["ALL"]
        assert service["security_opt"] == ["no-new-privileges:true"]


def test_base_images_can_be_pinned_by_digest() -> None:
    lines = (ROOT / "docker" / "images.env").read_text(encoding="utf-8").splitlines()
    images = dict(line.split("=") for line in lines if not line.startswith("#"))
    text = DOCKERFILE + "".join(file.read_text(encoding="utf-8") for file in (ROOT / "docker").glob("compose*.yaml"))
    used = dict(re.findall(r"\b([A-Z]+_IMAGE)(?::-|=)([\w.:/-]+)", text))
    # A digest in the file is not in the defaults.
    assert {name: image.partition("@")[0] for name, image in images.items()} == used
    assert set(re.findall(r"^FROM (\S+)", DOCKERFILE, re.MULTILINE)) == {"${PYTHON_IMAGE}"}


def check_schema(schema: str, file: Path) -> None:
    """Check a file against a schema that check-jsonschema brings along."""
    command = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", schema, file]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


def test_manifests_select_the_same_pods() -> None:
    spec = {kind: manifest.get("spec", {}) for kind, manifest in BY_KIND.items()}
    assert spec["Deployment"]["selector"]["matchLabels"] == LABELS
    assert spec["Service"]["selector"] == LABELS
    assert spec["PodDisruptionBudget"]["selector"]["matchLabels"] == LABELS
    assert spec["NetworkPolicy"]["podSelector"]["matchLabels"] == LABELS
    assert [rule["labelSelector"]["matchLabels"] for rule in POD["topologySpreadConstraints"]] == [LABELS]
    scaled = spec["HorizontalPodAutoscaler"]["scaleTargetRef"]
    assert (scaled["kind"], scaled["name"]) == ("Deployment", BY_KIND["Deployment"]["metadata"]["name"])
    # A number of replicas would override the autoscaler on every deployment.
    assert "replicas" not in spec["Deployment"]
    assert POD["serviceAccountName"] == BY_KIND["ServiceAccount"]["metadata"]["name"]
    assert [source["configMapRef"]["name"] for source in CONTAINER["envFrom"]] == [
        BY_KIND["ConfigMap"]["metadata"]["name"]
    ]


def test_manifest_settings_exist() -> None:
    given = {name: value for name, value in CONFIGURED.items() if name.startswith(PREFIX)}
    values: dict[str, Any] = {name.removeprefix(PREFIX).lower(): value for name, value in given.items()}
    assert Settings(**values).access.api_keys
    named = {variable["name"] for variable in CONTAINER["env"]}
    assert {name.removeprefix(PREFIX).lower() for name in named} <= SETTING_NAMES
    assert CONFIGURED.keys() - given.keys() == {"FORWARDED_ALLOW_IPS"}
    # Secret values come from a secret.
    assert all("value" not in entry and "secretKeyRef" in entry["valueFrom"] for entry in CONTAINER["env"])
    assert "database_url" not in {name.removeprefix(PREFIX).lower() for name in given}


def test_pod_has_minimal_rights() -> None:
    security = CONTAINER["securityContext"]
    assert security["readOnlyRootFilesystem"]
    assert security["allowPrivilegeEscalation"] is False
    assert security["capabilities"] == {"drop": ["ALL"]}
    assert POD["securityContext"]["runAsNonRoot"]
    assert POD["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
    assert POD["automountServiceAccountToken"] is False
    assert f"--uid {POD['securityContext']['runAsUser']} " in DOCKERFILE
    # Only the data folder and the temporary folder are writable.
    written = {mount["mountPath"] for mount in CONTAINER["volumeMounts"]}
    assert written == {"/tmp", *re.findall(r"LALALOC_DATA_DIR=(\S+)", DOCKERFILE)}
    assert {mount["name"] for mount in CONTAINER["volumeMounts"]} == {volume["name"] for volume in POD["volumes"]}
    assert all("sizeLimit" in volume["emptyDir"] for volume in POD["volumes"])


def test_ports_and_probes_match_the_service() -> None:
    [port] = CONTAINER["ports"]
    assert f"EXPOSE {port['containerPort']}" in DOCKERFILE
    assert BY_KIND["Service"]["spec"]["ports"][0]["targetPort"] == port["name"]
    probes = [CONTAINER[f"{kind}Probe"]["httpGet"] for kind in ("startup", "liveness", "readiness")]
    assert {probe["port"] for probe in probes} == {port["name"]}
    paths = {route.path for router in ROUTERS for route in router.routes if isinstance(route, APIRoute)}
    assert {probe["path"] for probe in probes} <= paths
    # A stopping service is alive but not ready, so it finishes its requests.
    assert CONTAINER["livenessProbe"]["httpGet"]["path"] == "/healthz"
    assert CONTAINER["readinessProbe"]["httpGet"]["path"] == "/readyz"


def test_autoscaler_uses_an_existing_metric() -> None:
    [by_requests] = [
        metric for metric in BY_KIND["HorizontalPodAutoscaler"]["spec"]["metrics"] if metric["type"] == "Pods"
    ]
    metric = by_requests["pods"]["metric"]["name"]
    file = ROOT / "docker" / "kubernetes" / "replicas" / "prometheus-adapter.yaml"
    adapter = yaml.safe_load(file.read_text(encoding="utf-8"))
    assert [rule["seriesQuery"].partition("{")[0] for rule in adapter["rules"]["custom"]] == [metric]
    telemetry = Telemetry()
    Admission(Settings(), telemetry)
    assert f"\n{metric} " in telemetry.render().decode()
    # The autoscaler adds pods before the running pods refuse requests.
    cores = int(CONTAINER["resources"]["limits"]["cpu"])
    shares = share_cores(cores, workers=None, compute_threads=0, onnx_threads=0)
    assert shares.compute_threads == cores
    assert int(by_requests["pods"]["target"]["averageValue"]) < 2 * (shares.workers + shares.compute_threads)


def test_node_can_be_drained_without_an_outage() -> None:
    scaling = BY_KIND["HorizontalPodAutoscaler"]["spec"]
    assert scaling["minReplicas"] > BY_KIND["PodDisruptionBudget"]["spec"]["maxUnavailable"]
    assert BY_KIND["Deployment"]["spec"]["strategy"]["rollingUpdate"]["maxUnavailable"] == 0

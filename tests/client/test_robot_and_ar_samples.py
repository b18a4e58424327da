"""Samples for robots and AR apps, as far as they run without ROS, Unity and WebXR."""

from __future__ import annotations

import importlib.util
import json
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest

from lalaloc_client.alignment import align
from lalaloc_client.frames import camera_matrix
from lalaloc_client.planar import map_from_base, of_answer, of_ros
from tests.client.test_robots_and_ar import device_world, rows_of, tilted, tracked
from tests.service.conftest import StartApp, upload

EXAMPLES = Path(__file__).parents[2] / "examples"
HEADINGS = (10.0, 130.0, 250.0)
POSES = [tracked(3.0, 2.0, heading) for heading in HEADINGS]


class _Node:
    """Stand-in for `rclpy.node.Node`: parameters, and what is published."""

    parameters: ClassVar[dict[str, Any]] = {}

    def __init__(self, _name: str) -> None:
        self.published: list[Any] = []

    def declare_parameter(self, name: str, value: Any) -> SimpleNamespace:
        return SimpleNamespace(value=self.parameters.get(name, value))

    def create_publisher(self, *_arguments: Any) -> SimpleNamespace:
        return SimpleNamespace(publish=self.published.append)

    def create_subscription(self, *_arguments: Any) -> None:
        pass


def _message(*_arguments: Any) -> SimpleNamespace:
    """Return a message of ROS with the fields that the sample sets."""

    def vector() -> SimpleNamespace:
        return SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)

    return SimpleNamespace(
        header=SimpleNamespace(stamp=None, frame_id=""),
        child_frame_id="",
        pose=SimpleNamespace(pose=SimpleNamespace(position=vector(), orientation=vector()), covariance=[]),
        transform=SimpleNamespace(translation=vector(), rotation=vector()),
    )


@pytest.fixture
def node_module(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Load the ROS node with stand-ins for ROS's packages; the client and its frames are the real ones."""
    sent: list[Any] = []
    contents = {
        "rclpy": {},
        "rclpy.node": {"Node": _Node},
        "geometry_msgs": {},
        "geometry_msgs.msg": {"PoseWithCovarianceStamped": _message, "TransformStamped": _message},
        "nav_msgs": {},
        "nav_msgs.msg": {"Odometry": _message},
        "sensor_msgs": {},
        "sensor_msgs.msg": {"CompressedImage": _message},
        "tf2_ros": {"TransformBroadcaster": lambda _node: SimpleNamespace(sendTransform=sent.append)},
    }
    for name, values in contents.items():
        module = ModuleType(name)
        vars(module).update(values)
        monkeypatch.setitem(sys.modules, name, module)
    spec = importlib.util.spec_from_file_location("localise_node", EXAMPLES / "robot" / "localise_node.py")
    assert spec is not None
    assert spec.loader is not None
    loaded: Any = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    loaded.sent = sent
    return loaded


def test_node_publishes_pose_and_map_to_odom(
    node_module: Any, start_app: StartApp, tmp_path: Path, sphere: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    with start_app(tmp_path) as app:
        plan_id = upload(app)
        given = {"url": str(app.base_url), "plan": plan_id, "camera_forward_m": 0.2, "min_probability": 0.0}
        monkeypatch.setattr(_Node, "parameters", given)
        node = node_module.LocaliseNode()
        photograph = _message()
        photograph.data, photograph.header.stamp = sphere, 12
        node.on_photograph(photograph)
        assert node.published == [], "there is no odometry yet"
        for x in (0.0, 0.5):
            odometry = _message()
            odometry.pose.pose.position.x = x
            node.on_odometry(odometry)
            node.on_photograph(photograph)
        session = app.get("/sessions/" + node.tracker.session.id).json()
        node.tracker.end()
        node.client.close()
    assert session["photographs"] == 2
    pose = session["pose"]
    (_, stated), (_, correction) = node.published, node_module.sent
    assert (stated.header.frame_id, stated.header.stamp) == ("map", 12)
    assert (correction.header.frame_id, correction.child_frame_id) == ("map", "odom")
    assert len(stated.pose.covariance) == 36
    place, turn = stated.pose.pose.position, stated.pose.pose.orientation
    base = of_ros(place.x, place.y, (turn.x, turn.y, turn.z, turn.w))
    answer = tracked(pose["position"]["x_m"], pose["position"]["y_m"], pose["heading_deg"])
    expected = map_from_base(answer, node.mount)
    assert (base.x_m, base.y_m) == pytest.approx((expected.x_m, expected.y_m), abs=1e-3)
    moved, turned = correction.transform.translation, correction.transform.rotation
    map_odom = of_ros(moved.x, moved.y, (turned.x, turned.y, turned.z, turned.w))
    camera = map_odom @ of_ros(0.5, 0.0, (0, 0, 0, 1)) @ node.mount
    assert (camera.x_m, camera.y_m) == pytest.approx((of_answer(answer).x_m, of_answer(answer).y_m), abs=1e-3)


@pytest.mark.skipif(shutil.which("mcs") is None, reason="no C# compiler: apt-get install mono-mcs")
def test_unity_sample_agrees_with_the_client(tmp_path: Path) -> None:
    world = device_world("unity")
    cameras = [world @ np.array(camera_matrix(pose, "unity")) @ tilted(0.3) for pose in POSES]
    expected = np.array(align(POSES, [rows_of(c) for c in cameras], "unity", camera_height_m=1.5).world_from_plan)

    def items(rows: Sequence[Mapping[Any, float]], kind: str) -> str:
        fields = [", ".join(f"{name} = {value!r}" for name, value in row.items()) for row in rows]
        return ", ".join(f"new {kind} {{ {row} }}" for row in fields)

    seen = [dict(zip(("X", "Y", "Z"), map(float, c[:3, 3]), strict=True)) for c in cameras]
    for row, camera in zip(seen, cameras, strict=True):
        row |= dict(zip(("ForwardX", "ForwardY", "ForwardZ"), map(float, camera[:3, 2]), strict=True))
    poses = [{"X": p.position.x_m, "Y": p.position.y_m, "HeadingDeg": p.heading_deg} for p in POSES]
    (tmp_path / "Main.cs").write_text(
        "using System; using System.Globalization; class Program { static void Main() { double x, y, z;"
        f"LalalocAlignment.Align(new[] {{ {items(poses, 'LalalocPose')} }}, "
        f"new[] {{ {items(seen, 'LalalocCamera')} }}, 1.5).Point(1.0, 4.0, 2.0, out x, out y, out z);"
        'Console.WriteLine(String.Format(CultureInfo.InvariantCulture, "[{0:R},{1:R},{2:R}]", x, y, z)); } }'
    )
    program = tmp_path / "program.exe"
    command = ["mcs", f"-out:{program}", EXAMPLES / "ar" / "LalalocAlignment.cs", tmp_path / "Main.cs"]
    compiled = subprocess.run(command, capture_output=True, text=True, check=False)
    assert compiled.returncode == 0, compiled.stderr
    printed = subprocess.run(["mono", program], capture_output=True, text=True, check=True).stdout
    np.testing.assert_allclose(json.loads(printed), (expected @ [1.0, 2.0, 4.0, 1.0])[:3], atol=1e-6)


def test_samples_say_how_far_they_were_run() -> None:
    samples = [path for folder in ("robot", "ar") for path in (EXAMPLES / folder).iterdir() if path.is_file()]
    assert len(samples) == 3
    for sample in samples:
        assert "This sample was not run" in sample.read_text(encoding="utf-8")

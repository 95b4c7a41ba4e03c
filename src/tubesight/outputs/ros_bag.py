"""A recording as a ROS 2 bag of standard messages, in metres; ROS itself is not needed (extra ``ros``)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from tubesight.core import Array, InputError
from tubesight.files.images import decode_image
from tubesight.files.nested import dump_yaml
from tubesight.files.packages import require_package
from tubesight.files.recording import IMAGE_SCHEMA, RecordedPicture, RecordedSwitch, Recording
from tubesight.files.rig import rig_from_text
from tubesight.files.safe import write_atomic
from tubesight.geometry.pose import turn_onto

_RULE = "=" * 80
_HEADER = f"""{_RULE}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{_RULE}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
_POSE = f"""{_RULE}
MSG: geometry_msgs/Pose
Point position
Quaternion orientation
{_RULE}
MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
{_RULE}
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
"""
# By type: its definition with those of its parts, as in ROS 2.
_TYPES = {
    "geometry_msgs/msg/PoseWithCovarianceStamped": "std_msgs/Header header\nPoseWithCovariance pose\n"
    + _HEADER
    + f"{_RULE}\nMSG: geometry_msgs/PoseWithCovariance\nPose pose\nfloat64[36] covariance\n"
    + _POSE,
    "nav_msgs/msg/Path": "std_msgs/Header header\ngeometry_msgs/PoseStamped[] poses\n"
    + _HEADER
    + f"{_RULE}\nMSG: geometry_msgs/PoseStamped\nstd_msgs/Header header\nPose pose\n"
    + _POSE,
    "std_msgs/msg/String": "string data\n",
    "sensor_msgs/msg/CompressedImage": IMAGE_SCHEMA,
}
_TOPICS = {
    "/tubesight/tip": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/tubesight/centreline": "nav_msgs/msg/Path",
    "/tubesight/status": "std_msgs/msg/String",
}
_M_PER_MM = 1e-3
_LONG_AGO_NS = 2**63 - 1


def write_ros_bag(recording: Recording, out: Path) -> int:
    """Write a folder with ``metadata.yaml`` and one MCAP file; returns the number of messages.

    Topics: ``/tubesight/tip`` (position, direction of the tube as +z, covariance of the position; that of the
    direction is not known: -1), ``/tubesight/centreline``, ``/tubesight/status`` (state and status) and
    ``/camera/NAME/compressed``. Frame: that of the rig, ``clamp`` once it is registered.

    Raises
    ------
    InputError
        If the package for ROS messages is missing, or the place cannot be written.
    """
    require_package("mcap_ros2", "ros", f"{out}: needs the package mcap-ros2-support")
    from mcap_ros2.writer import Writer

    path = out / f"{out.name}_0.mcap"
    counts: dict[str, int] = {}
    types = dict(_TOPICS)
    span = [_LONG_AGO_NS, 0]
    try:
        out.mkdir(parents=True, exist_ok=True)
        with path.open("xb") as stream:
            writer = Writer(stream)
            schemas = {kind: writer.register_msgdef(kind, text) for kind, text in _TYPES.items()}
            for time_ns, topic, message in _messages(recording):
                kind = types.setdefault(topic, "sensor_msgs/msg/CompressedImage")
                writer.write_message(topic, schemas[kind], message, time_ns, time_ns, counts.get(topic, 0))
                counts[topic] = counts.get(topic, 0) + 1
                span = [min(span[0], time_ns), max(span[1], time_ns)]
            writer.finish()  # type: ignore[no-untyped-call]
    except FileExistsError:
        raise InputError(f"{path}: is there already; name a new folder") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); choose another place") from error
    write_atomic(out / "metadata.yaml", dump_yaml(_metadata(path.name, counts, types, span)))
    return sum(counts.values())


def _messages(recording: Recording) -> Iterator[tuple[int, str, dict[str, Any]]]:
    """Yield times, topics and messages in the order of the recording."""
    frame = rig_from_text(str(recording.configuration.get("rig", "")), recording.path).rig.base_frame
    for entry in recording.entries():
        if isinstance(entry, RecordedSwitch):
            continue
        header = _header(entry.time_ns, frame)
        if isinstance(entry, RecordedPicture):
            form, data = _shown(entry)
            image = {"header": _header(entry.time_ns, entry.camera), "format": form, "data": data}
            yield entry.time_ns, f"/camera/{entry.camera}/compressed", image
            continue
        row = entry.data.get("row") or {}
        status = f"{entry.data.get('state', '')} {row.get('status', '')}".strip()
        yield entry.time_ns, "/tubesight/status", {"data": status}
        xyz = entry.data.get("xyz_mm")
        if xyz is None:
            continue
        points = np.array(xyz, float) * _M_PER_MM
        poses = [_pose(p, d) for p, d in zip(points, _directions(points), strict=True)]
        sd = [row.get(f"tip_{axis}_sd_mm") for axis in "xyz"]
        variance = [(s * _M_PER_MM) ** 2 if s is not None else -1.0 for s in sd] + [-1.0] * 3
        tip = {"pose": poses[-1], "covariance": np.diag(variance).ravel().tolist()}
        yield entry.time_ns, "/tubesight/tip", {"header": header, "pose": tip}
        path = {"header": header, "poses": [{"header": header, "pose": pose} for pose in poses]}
        yield entry.time_ns, "/tubesight/centreline", path


def _shown(picture: RecordedPicture) -> tuple[str, bytes]:
    """Return format and data of a picture as ROS knows them: JPEG, or PNG."""
    if picture.format in ("jpeg", "png"):
        return picture.format, picture.data
    image = decode_image(picture.data, f"{picture.camera} {picture.number}")
    return "png", cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()


def _header(time_ns: int, frame: str) -> dict[str, Any]:
    return {"stamp": {"sec": time_ns // 10**9, "nanosec": time_ns % 10**9}, "frame_id": frame}


def _directions(points: Array) -> Array:
    """Return unit tangents (N, 3) along a row of points."""
    steps = np.gradient(points, axis=0)
    return np.asarray(steps / np.linalg.norm(steps, axis=1, keepdims=True))


def _pose(point: Array, direction: Array) -> dict[str, Any]:
    """Pose whose +z runs along the tube: the shortest turn that carries z there."""
    turn = Rotation.from_matrix(turn_onto(direction)).as_quat(canonical=True)
    return {
        "position": dict(zip("xyz", (float(v) for v in point), strict=True)),
        "orientation": dict(zip("xyzw", turn.tolist(), strict=True)),
    }


def _metadata(name: str, counts: Mapping[str, int], types: Mapping[str, str], span: Sequence[int]) -> dict[str, Any]:
    """Content of ``metadata.yaml`` of rosbag2, version 5: what ROS 2 Humble and later read."""
    start, end = (span[0], span[1]) if counts else (0, 0)
    topics = [
        {
            "topic_metadata": {
                "name": topic,
                "type": types[topic],
                "serialization_format": "cdr",
                "offered_qos_profiles": "",
            },
            "message_count": count,
        }
        for topic, count in counts.items()
    ]
    return {
        "rosbag2_bagfile_information": {
            "version": 5,
            "storage_identifier": "mcap",
            "relative_file_paths": [name],
            "duration": {"nanoseconds": end - start},
            "starting_time": {"nanoseconds_since_epoch": start},
            "message_count": sum(counts.values()),
            "topics_with_message_count": topics,
            "compression_format": "",
            "compression_mode": "",
            "files": [
                {
                    "path": name,
                    "starting_time": {"nanoseconds_since_epoch": start},
                    "duration": {"nanoseconds": end - start},
                    "message_count": sum(counts.values()),
                }
            ],
        }
    }

#!/usr/bin/env python3
"""Makes the test data of vergence-ros in crates/ros/tests/data by implementations that are not ours.

samples.json: one message of every type that vergence-ros has, with its definition and its CDR bytes
(PyPI `rosbags`). Every leaf gets the next number of a count, so that two fields that change places
are seen. zstd.mcap, lz4.mcap, plain.mcap: six pictures in chunks of each compression, recorded out
of order (PyPI `mcap`).

    pip install rosbags mcap mcap-ros2-support && python3 scripts/ros_samples.py
"""

import itertools
import json
from pathlib import Path

from mcap.writer import CompressionType
from mcap_ros2.writer import Writer
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

OUT = Path(__file__).parent.parent / "crates/ros/tests/data"
TYPES = [
    "builtin_interfaces/msg/Time",
    "builtin_interfaces/msg/Duration",
    "std_msgs/msg/Header",
    "std_msgs/msg/String",
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/CompressedImage",
    "sensor_msgs/msg/RegionOfInterest",
    "sensor_msgs/msg/CameraInfo",
    "sensor_msgs/msg/JointState",
    "geometry_msgs/msg/Point",
    "geometry_msgs/msg/Vector3",
    "geometry_msgs/msg/Quaternion",
    "geometry_msgs/msg/Pose",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovariance",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/PointStamped",
    "geometry_msgs/msg/Transform",
    "geometry_msgs/msg/TransformStamped",
    "tf2_msgs/msg/TFMessage",
    "trajectory_msgs/msg/JointTrajectoryPoint",
    "trajectory_msgs/msg/JointTrajectory",
]

store = get_typestore(Stores.ROS2_JAZZY)


def leaf(kind, number):
    if kind == "string":
        return "téxt " + "x" * (number % 5) + str(number)
    if kind == "bool":
        return True
    if kind.startswith("float"):
        return -number - 0.25
    return number % 256 if kind == "uint8" else number


def value(node, count):
    """A plain value (numbers, strings, lists, dicts) of a field of the given type."""
    kind, detail = node
    if kind == Nodetype.BASE:
        return leaf(detail[0], next(count))
    if kind == Nodetype.NAME:
        return sample(detail, count)
    element, length = detail
    return [value(element, count) for _ in range(length if kind == Nodetype.ARRAY else 3)]


def sample(name, count):
    return {field: value(node, count) for field, node in store.get_msgdef(name).fields}


def message(name, plain):
    """The same as an object of `rosbags`."""
    import numpy

    def build(node, plain):
        kind, detail = node
        if kind == Nodetype.BASE:
            return plain
        if kind == Nodetype.NAME:
            return message(detail, plain)
        element = detail[0]
        if element[0] == Nodetype.BASE and element[1][0] != "string":
            return numpy.array(plain, dtype=element[1][0])
        return [build(element, item) for item in plain]

    fields = store.get_msgdef(name).fields
    return store.types[name](**{field: build(node, plain[field]) for field, node in fields})


def main():
    samples = []
    for name in TYPES:
        plain = sample(name, itertools.count(1))
        samples.append(
            {
                "type": name,
                "definition": store.generate_msgdef(name, ros_version=2)[0],
                "cdr_little_endian": bytes(store.serialize_cdr(message(name, plain), name)).hex(),
                "cdr_big_endian": bytes(
                    store.serialize_cdr(message(name, plain), name, little_endian=False)
                ).hex(),
                "value": plain,
            }
        )
    (OUT / "samples.json").write_text(json.dumps(samples, indent=1) + "\n")
    for name, compression in [
        ("zstd", CompressionType.ZSTD),
        ("lz4", CompressionType.LZ4),
        ("plain", CompressionType.NONE),
    ]:
        pictures(OUT / f"{name}.mcap", compression)


def pictures(path, compression):
    """Six mono8 pictures of 40x30, rows padded to 48 bytes; pixel = (x + 2 y + number) % 256.

    Stamps are number + 0.5 s; number 3 is recorded before number 2, and number 4 twice.
    """
    writer = Writer(str(path), chunk_size=4096, compression=compression)
    name = "sensor_msgs/msg/Image"
    schema = writer.register_msgdef(name, store.generate_msgdef(name, ros_version=2)[0])
    for place, number in enumerate([0, 1, 3, 2, 4, 4, 5]):
        rows = [[(x + 2 * y + number) % 256 for x in range(40)] + [255] * 8 for y in range(30)]
        writer.write_message(
            "/camera/image_raw",
            schema,
            {
                "header": {"stamp": {"sec": number, "nanosec": 500_000_000}, "frame_id": "eye"},
                "height": 30,
                "width": 40,
                "encoding": "mono8",
                "is_bigendian": 0,
                "step": 48,
                "data": bytes(sum(rows, [])),
            },
            log_time=place * 10**9,
            publish_time=place * 10**9,
        )
    writer.finish()


if __name__ == "__main__":
    main()

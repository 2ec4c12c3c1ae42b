#!/usr/bin/env python3
"""Reads a recording with ROS tooling that is not ours (PyPI `mcap-ros2-support`) and checks it.

    pip install mcap-ros2-support
    python3 scripts/check_recording.py recording.mcap [--topic /left/image_raw ...] [--samples FILE]

Decodes every message by the definition that the file carries, checks the index against the messages,
that recording times and stamps never go back on a topic (and grow from picture to picture), that
pictures have the size they claim, that rotations are unit quaternions, that joint states and
trajectories have a position for each joint, and that a trajectory starts at rest where the arm stands; prints a table of topics.
`--topic`: must be there with at least one message. `--samples`: compare `/sample/...` messages field
by field with `crates/ros/tests/data/samples.json`. Exit status 1 and a list when something is wrong.
"""

import argparse
import json
import sys
from collections import defaultdict

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

# Bytes of a pixel.
PIXEL = {"mono8": 1, "mono16": 2, "rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording")
    parser.add_argument("--topic", action="append", default=[], help="must carry messages")
    parser.add_argument("--samples", help="values that /sample/... messages must have")
    arguments = parser.parse_args()

    check = Check()
    try:
        check.read(arguments.recording)
    except Exception as error:  # Any failure of the foreign reader is what this script looks for.
        check.wrong(f"not readable: {type(error).__name__}: {error}")
    for topic in arguments.topic:
        if topic not in check.topics:
            check.wrong(f"no message on {topic}")
    if arguments.samples:
        with open(arguments.samples, encoding="utf-8") as file:
            check.compare(json.load(file))
    check.report()
    return 1 if check.problems else 0


class Topic:
    def __init__(self, kind):
        self.kind = kind
        self.messages = []
        self.bytes = 0
        self.log_time = self.stamp = None
        self.note = ""


class Check:
    def __init__(self):
        self.problems = []
        self.topics = {}
        self.joints = {}

    def wrong(self, problem):
        self.problems.append(problem)

    def read(self, path):
        with open(path, "rb") as file:
            reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
            if reader.get_header().profile != "ros2":
                self.wrong(f"profile {reader.get_header().profile!r} is not 'ros2'")
            summary = reader.get_summary()
            if summary is None or summary.statistics is None:
                self.wrong("no index at the end of the file")
            # In the order of the file: sorting would hide times that go back.
            in_file_order = reader.iter_decoded_messages(log_time_order=False)
            for schema, channel, message, decoded in in_file_order:
                topic = self.topics.setdefault(channel.topic, Topic(schema.name))
                self.message(channel.topic, topic, schema, channel, message, decoded)
            if summary is not None and summary.statistics is not None:
                self.counts(summary)

    def counts(self, summary):
        counted = defaultdict(int)
        for channel, count in summary.statistics.channel_message_counts.items():
            counted[summary.channels[channel].topic] += count
        found = {name: len(topic.messages) for name, topic in self.topics.items()}
        if dict(counted) != found:
            self.wrong(f"the index counts {dict(counted)}, the file has {found}")
        if not found:
            self.wrong("no message at all")

    def message(self, name, topic, schema, channel, message, decoded):
        where = f"{name} message {len(topic.messages)}"
        if (schema.encoding, channel.message_encoding) != ("ros2msg", "cdr"):
            self.wrong(f"{where}: {schema.encoding} in {channel.message_encoding}")
        if topic.log_time is not None and message.log_time < topic.log_time:
            self.wrong(f"{where}: recorded at {message.log_time} after {topic.log_time}")
        topic.log_time = message.log_time
        if hasattr(decoded, "header") and not name.startswith("/sample/"):
            self.stamp(where, topic, decoded.header.stamp)
        if schema.name == "sensor_msgs/msg/Image" and not name.startswith("/sample/"):
            self.picture(where, topic, decoded)
        if schema.name == "tf2_msgs/msg/TFMessage" and not name.startswith("/sample/"):
            self.transforms(where, topic, decoded)
        if schema.name == "sensor_msgs/msg/JointState" and not name.startswith("/sample/"):
            self.joint_state(where, decoded)
        if schema.name == "trajectory_msgs/msg/JointTrajectory" and not name.startswith("/sample/"):
            self.trajectory(where, topic, decoded)
        topic.bytes += len(message.data)
        topic.messages.append(decoded)

    def stamp(self, where, topic, stamp):
        stamp = stamp.sec * 10**9 + stamp.nanosec
        pictures = "Image" in topic.kind
        if topic.stamp is not None and (stamp < topic.stamp or pictures and stamp == topic.stamp):
            self.wrong(f"{where}: stamp {stamp} after {topic.stamp}")
        topic.stamp = stamp

    def picture(self, where, topic, image):
        topic.note = f"{image.width}x{image.height} {image.encoding}"
        row = image.width * PIXEL.get(image.encoding, 1)
        if image.width < 1 or image.height < 1 or image.step < row:
            self.wrong(f"{where}: {topic.note} with {image.step} bytes a row")
        if len(image.data) != image.step * image.height:
            self.wrong(f"{where}: {len(image.data)} bytes for {image.step} x {image.height}")

    def transforms(self, where, topic, message):
        edges = {(t.header.frame_id, t.child_frame_id) for t in message.transforms}
        topic.note = f"{len(edges)} frames"
        for edge in message.transforms:
            q = edge.transform.rotation
            if abs(q.x**2 + q.y**2 + q.z**2 + q.w**2 - 1) > 1e-6:
                self.wrong(f"{where}: the rotation to {edge.child_frame_id} is no unit quaternion")

    def joint_state(self, where, state):
        if len(state.name) != len(state.position) or not state.name:
            self.wrong(f"{where}: {len(state.name)} joints, {len(state.position)} positions")
        self.joints.update(zip(state.name, state.position))

    def trajectory(self, where, topic, motion):
        names, points = list(motion.joint_names), motion.points
        topic.note = f"{len(names)} joints"
        times = [p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in points]
        if not points or any(b <= a for a, b in zip(times, times[1:])):
            self.wrong(f"{where}: {len(points)} points, times that do not rise")
            return
        if any(len(p.positions) != len(names) for p in points):
            self.wrong(f"{where}: points without a position for each joint")
            return
        if any(abs(v) > 1e-6 for p in (points[0], points[-1]) for v in p.velocities):
            self.wrong(f"{where}: does not start and end at rest")
        for name, position in zip(names, points[0].positions):
            if abs(self.joints.get(name, position) - position) > 1e-3:
                self.wrong(f"{where}: starts with {name} at {position}, it is at {self.joints[name]}")

    def compare(self, samples):
        for sample in samples:
            name = "/sample/" + sample["type"].replace("/msg/", "/")
            topic = self.topics.get(name)
            if topic is None or topic.kind != sample["type"]:
                self.wrong(f"no sample of {sample['type']}")
                continue
            for difference in differences(name, sample["value"], topic.messages[0]):
                self.wrong(difference)

    def report(self):
        width = max([len(name) for name in self.topics] + [5])
        print(f"{'topic':{width}}  messages   bytes  type")
        for name, topic in sorted(self.topics.items()):
            count = len(topic.messages)
            print(f"{name:{width}}  {count:8} {topic.bytes:>8} {topic.kind} {topic.note}".rstrip())
        for problem in self.problems:
            print(f"WRONG: {problem}", file=sys.stderr)
        if not self.problems:
            print("every message decodes; counts, times and sizes agree")


def differences(where, expected, found):
    """Yields where a decoded message is not the plain value."""
    if isinstance(expected, dict):
        fields = list(found.__slots__) if hasattr(found, "__slots__") else list(vars(found))
        if fields != list(expected):
            yield f"{where}: fields {fields}, not {list(expected)}"
            return
        for field, value in expected.items():
            yield from differences(f"{where}.{field}", value, getattr(found, field))
    elif isinstance(expected, list):
        if len(expected) != len(found):
            yield f"{where}: {len(found)} elements, not {len(expected)}"
            return
        for index, (value, other) in enumerate(zip(expected, found)):
            yield from differences(f"{where}[{index}]", value, other)
    elif expected != found:
        yield f"{where}: {found!r}, not {expected!r}"


if __name__ == "__main__":
    sys.exit(main())

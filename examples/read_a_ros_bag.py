"""My recordings are ROS bags. How do they become recordings of the robot?"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

import rfdropo_bayes as rb

arm = rb.Model("smooth_arm", simulator={"time_step": 0.01})
walk = {"duration": 4.0, "interval": 0.4, "step": 0.006, "low": 0.0, "high": 0.02, "sample_time": 0.02}
run = rb.simulate(arm, {**walk, "recordings": ["monday"]}, noise={"standard_deviation": 3e-4})[0]

# In the place of `ros2 bag record`: a pose of the tip from motion capture, and the pulls that a node sent [m].
store = get_typestore(Stores.ROS2_HUMBLE)
kinds = {name: store.types[name] for name in ("geometry_msgs/msg/PoseStamped", "std_msgs/msg/Float64MultiArray")}
header, stamp = store.types["std_msgs/msg/Header"], store.types["builtin_interfaces/msg/Time"]
point, turn = store.types["geometry_msgs/msg/Point"], store.types["geometry_msgs/msg/Quaternion"]
pose, layout = store.types["geometry_msgs/msg/Pose"], store.types["std_msgs/msg/MultiArrayLayout"]
poses, pulls = kinds.values()
messages = []
for time, place in zip(run.time, run.position[:, -1], strict=True):
    seen = header(stamp(int(time), round(1e9 * (time % 1.0))), "base")
    messages.append(("/mocap/tip", time, poses(seen, pose(point(*place), turn(0.0, 0.0, 0.0, 1.0)))))
for time, sent in zip(run.command_time, run.command, strict=True):
    messages.append(("/pulls", max(time, 0.0), pulls(layout([], 0), np.asarray(sent, dtype=float))))

with TemporaryDirectory() as folder:
    with Writer(Path(folder) / "monday", version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        named = zip(("/mocap/tip", "/pulls"), kinds, strict=True)
        topics = {topic: bag.add_connection(topic, kind, typestore=store) for topic, kind in named}
        for topic, time, message in sorted(messages, key=lambda each: each[1]):
            bag.write(topics[topic], round(1e9 * time), store.serialize_cdr(message, topics[topic].msgtype))
    columns = {
        "time": "header",
        "positions": [[f"/mocap/tip.pose.position.{axis}" for axis in "xyz"]],
        "markers": ["tip"],
        "commands": [f"/pulls.data[{k}]" for k in range(run.command.shape[1])],
        "cables": list(run.cable_names),
        "command_unit": "m",
        "position_unit": "m",
    }
    (read,) = rb.read("monday", format="rosbag", columns=columns, folder=folder)

figure, axes = plt.subplots(2, 1, figsize=(8, 4.5), sharex=True, layout="constrained")
axes[0].plot(read.time, 1e3 * read.position[:, 0], label=["x", "y", "z"])
axes[0].set_ylabel("tip [mm]")
axes[0].legend()
axes[1].step(read.time, 1e3 * read.command_at(read.time), where="post", label=read.cable_names)
axes[1].set(xlabel="time [s]", ylabel="pull [mm]")
axes[1].legend()
figure.savefig(sys.argv[1] if len(sys.argv) > 1 else "read_a_ros_bag.png")
off = float(np.abs(read.position[:, 0] - run.position[: len(read.time), -1]).max())
print(f"{len(read.time)} poses and {len(read.command)} commands; positions differ by {1e3 * off:.2g} mm")
assert off < 1e-9

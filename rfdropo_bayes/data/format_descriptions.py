"""One line on each format of recordings, to find the format of a given file."""

from __future__ import annotations

FORMATS: dict[str, str] = {
    "csv": "any CSV, plain or gzipped, whose columns the table [data.columns] names: for any robot",
    "motive-csv": "exports of Motive (OptiTrack); [data.columns] names its columns, commands are in another file",
    "rosbag": "bags of ROS 1 and ROS 2, MCAP among them; [data.columns] names fields of messages",
    "lerobot": "LeRobotDatasets, versions 2 and 3, an episode a recording; [data.columns] names features",
    "mat": "MATLAB's files of arrays; [data.columns] names arrays, and their columns by number, as `tip[0]`",
    "npz": "NumPy's files of arrays, named in the same way",
    "netcdf": "files written by `rfdropo simulate` and `Trajectory.save`",
    "asl-csv": "observations and control inputs of Stanford's hanging trunk (StanfordASL/trunk-stack), in two files",
    "optitrack-csv": "motion capture of the paper's trunk and cube (vandaele/sim2real-trunk)",
    "sofa-csv": "SOFA rollouts of the paper's scene (andreaprotopapa/sofa-dr-rl): action, x0, y0, z0, ... in mm",
}

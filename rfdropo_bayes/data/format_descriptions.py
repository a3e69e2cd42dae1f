"""What each format of recordings is, in one line: for whoever has files and asks what reads them."""

from __future__ import annotations

FORMATS: dict[str, str] = {
    "csv": "any CSV, plain or gzipped, whose columns the table [data.columns] names: the way in for one's own robot",
    "motive-csv": "what Motive (OptiTrack) exports; [data.columns] names its columns, commands are in another file",
    "rosbag": "bags of ROS 1 and ROS 2, MCAP among them; [data.columns] names fields of messages",
    "lerobot": "LeRobotDatasets, versions 2 and 3, an episode a recording; [data.columns] names features",
    "mat": "MATLAB's files of arrays; [data.columns] names arrays, and their columns by number, as `tip[0]`",
    "npz": "NumPy's files of arrays, named in the same way",
    "netcdf": "what `rfdropo simulate` and `Trajectory.save` write",
    "asl-csv": "observations and control inputs of Stanford's hanging trunk (StanfordASL/trunk-stack), in two files",
    "optitrack-csv": "motion capture of the paper's trunk and cube (vandaele/sim2real-trunk)",
    "sofa-csv": "SOFA rollouts of the paper's scene (andreaprotopapa/sofa-dr-rl): action, x0, y0, z0, ... in mm",
}

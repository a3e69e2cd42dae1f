"""Robot descriptions: geometry, cables, motors, markers and parameters, read from TOML and validated."""

from rfdropo_bayes.robots.cable import Cable, Motor
from rfdropo_bayes.robots.catalogue import find_robot_file, known_robots
from rfdropo_bayes.robots.drive_travel import DriveTravel, Travel, travel_in
from rfdropo_bayes.robots.robot import OBJECT, PushScene, Robot, robot_shape
from rfdropo_bayes.robots.sections import Cone, Cylinder, Disks, Tube, section_profile

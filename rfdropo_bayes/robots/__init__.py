"""Robot descriptions: geometry, cables, motors, markers and parameters, read from TOML and validated."""

from rfdropo_bayes.robots.cable import Cable
from rfdropo_bayes.robots.catalogue import find_robot_file, known_robots
from rfdropo_bayes.robots.drive_travel import DriveTravel, Travel, travel_in
from rfdropo_bayes.robots.motor import Motor
from rfdropo_bayes.robots.robot import OBJECT, PushScene, Robot
from rfdropo_bayes.robots.sections import Cone, Cylinder, Disks, Tube, section_profile
from rfdropo_bayes.robots.shape import robot_shape

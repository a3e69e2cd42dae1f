"""Channels of measurements: each predicts readings from a rollout, and has their likelihood."""

from rfdropo_bayes.bayes.channels.channel import Channel, FeatureChannel, Seen, Series
from rfdropo_bayes.bayes.channels.markers import Markers
from rfdropo_bayes.bayes.channels.motor_angle import MotorAngle
from rfdropo_bayes.bayes.channels.object_pose import ObjectPose
from rfdropo_bayes.bayes.channels.orientation import Orientation
from rfdropo_bayes.bayes.channels.tension import Tension
from rfdropo_bayes.bayes.channels.weighed import Weighed, WeighedParts

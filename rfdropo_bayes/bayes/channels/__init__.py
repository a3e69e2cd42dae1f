"""What is measured, channel by channel: each says what a rollout should show, and how likely is what was read."""

from rfdropo_bayes.bayes.channels.channel import Channel, FeatureChannel, Seen, Series
from rfdropo_bayes.bayes.channels.markers import Markers
from rfdropo_bayes.bayes.channels.motor_angle import MotorAngle
from rfdropo_bayes.bayes.channels.object_pose import ObjectPose
from rfdropo_bayes.bayes.channels.orientation import Orientation
from rfdropo_bayes.bayes.channels.tension import Tension
from rfdropo_bayes.bayes.channels.weighed import Weighed, WeighedParts

__all__ = [
    "Channel",
    "FeatureChannel",
    "Markers",
    "MotorAngle",
    "ObjectPose",
    "Orientation",
    "Seen",
    "Series",
    "Tension",
    "Weighed",
    "WeighedParts",
]

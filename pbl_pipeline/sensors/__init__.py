"""Wearable inertial sensors: their logs, their orientation, and what a fit takes from them."""

from .checked import check_day, places
from .formats.read import read_samples
from .given import Given, Read, given_sensors, named, once, read_given, sensors_in
from .log import SEGMENTS, SensorLog

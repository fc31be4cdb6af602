"""Wearable inertial sensors: their logs, their orientation, and what a fit takes from them."""

from .checked import check_day, places
from .given import Given, given_sensors, named, read_given
from .log import SEGMENTS, SensorLog

"""Formats of the logs of wearable sensors, a module for each; docs/imu.md lists them."""

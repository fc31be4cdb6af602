"""Wearable inertial sensors: their logs, their orientation, and what a fit takes from them."""

"""The stated confidence of a detector's points against their measured error."""

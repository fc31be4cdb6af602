"""Walks whose joint angles are known, seen with a detector's errors, and how far their fits are off."""

"""Decisions of people about results: what there is to decide, and the rows that record it."""

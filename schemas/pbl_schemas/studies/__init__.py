"""Studies: visits and scores from sheets and forms, and frozen slices."""

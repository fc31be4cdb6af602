"""Optimisers: they know residuals, losses and linear systems, nothing of bodies."""

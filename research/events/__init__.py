"""Training of the event model: corpus, augmentation, optimisation (`python -m research.events`)."""

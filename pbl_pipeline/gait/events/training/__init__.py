"""Training of the event model: corpus, augmentation, optimisation (`python -m pbl_pipeline.gait.events.training`)."""

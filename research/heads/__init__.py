"""Coverage of heads in real recordings by `pbl deidentify`, against heads located by eye."""

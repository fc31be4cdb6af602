"""How many heads of real recordings `pbl deidentify` covers, against heads located by eye."""

"""Operating a database server: start it, back it up, manage accounts, configure clients, remove a person."""

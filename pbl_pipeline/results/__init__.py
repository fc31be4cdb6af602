"""What a computation returns: frozen records, each with the columns of its row."""

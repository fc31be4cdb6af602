"""Registration of recordings and of what belongs to them."""

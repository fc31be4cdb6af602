"""The network of the event model: what it sees (`features`), what it is (`transformer`), and how it runs (`predict`).

Import the module you need: JAX loads only with `transformer`.
"""

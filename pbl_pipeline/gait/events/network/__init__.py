"""The network of the event model: its input (`features`), its layers (`transformer`), and its inference (`predict`).

Import the module you need: JAX loads only with `transformer`.
"""

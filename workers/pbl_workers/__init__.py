from . import errors as _errors  # registers the codes

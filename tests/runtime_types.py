"""The checker behind the array annotations while tests run.

An ``int`` passes for a ``float``, as in static typing; array shapes and dtypes are taken at their word.
"""

from beartype import BeartypeConf, beartype

checked = beartype(conf=BeartypeConf(is_pep484_tower=True))

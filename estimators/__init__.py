"""The estimators under test: `methods` composed of `core`, `blocks`, `aiding` and `policies`; `learning`; and `peers`.

The bench finds them by name through the entry-point group ``testbed.estimators``; importing this package stays light.
"""

import testbed  # noqa: F401  (it says where compiled code is kept, before numba is imported; old names of modules)

"""The estimators under test: one module per method, over shared kernels (`strapdown`, `error_model`, `kalman`).

The bench finds them by name through the entry-point group ``testbed.estimators``; importing this package stays light.
"""

import testbed  # noqa: F401  (it says where compiled code is kept, before numba is imported)

"""Models, measurements and tracks of other libraries, in and out; each module imports its library when it is imported.

``torchfra.adapters.filterpy``, ``torchfra.adapters.stonesoup``, ``torchfra.adapters.frames`` (pandas and polars),
``torchfra.adapters.poses`` (xarray), ``torchfra.adapters.scikit`` (scikit-learn).
"""

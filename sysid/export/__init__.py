"""A plant for other libraries: linearised, python-control, scipy, CasADi, FMU."""

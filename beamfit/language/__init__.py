"""The modelling language: constrained problems stated as text (report 3.1.2 to 3.1.5).

A document (`document`) of expressions (`expression`) is read from text by `parse` or from the
report's XML by `xml`, named and ordered without JAX by `declare`, `scope` and `plan`, and compiled
to JAX over whole index sets by `compiled`. `problem` makes it a `beamfit.greybox.problem.Problem`.
"""

"""The modelling language: constrained problems stated as text (report 3.1.2 to 3.1.5).

A document (`document`) of expressions (`expression`) is read from text by `parse` or from the
report's XML by `xml`. Without JAX, `scope` checks its names and indices and `plan` orders its
statements. `compiled` translates it to JAX over whole index sets, and `problem` makes it a
`beamfit.greybox.problem.Problem`.
"""

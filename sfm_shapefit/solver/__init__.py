"""The core: solvers of the ShapeFit program, and the certificate of what they return.

No input or output, no log, no random draw. `solve.solve` is the entry;
`certificate.certify` trusts no solver.
"""

"""The core: solvers of the ShapeFit program (`solve.solve`), and the certificate of what they return.

No input or output, no log, no random draw. `certificate.certify` trusts no solver.
"""

"""How fast it is: every figure beside its target, its limit, its baseline and what peers reach.

    python -m benchmarks                      # everything, a few minutes
    python -m benchmarks correlator loop      # some of it
    python -m benchmarks --json bench.json    # the same figures for a program

Figures are CPU time of one thread, best of several; cases of a group take turns, so that a ratio
to the baseline holds on a busy machine.  The baselines are plain code of this folder.
"""

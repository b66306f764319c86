"""Small neural networks that learn inside an estimator: feed-forward core, Levenberg-Marquardt, NARX.

`mlp.Mlp` is the network, `levenberg_marquardt.train` trains it, `narx.Narx` gives it memory; `mlp_kernels` computes.
"""

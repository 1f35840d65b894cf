"""The attentive-recurrent drop detector: network, inference and training."""

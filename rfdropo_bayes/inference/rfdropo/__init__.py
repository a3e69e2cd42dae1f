"""RF-DROPO: a distribution to randomise over, searched so that its rollouts match a trajectory."""

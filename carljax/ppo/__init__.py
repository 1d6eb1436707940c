"""PPO: policy, network, rollout, advantages, loss and the one jitted train step."""

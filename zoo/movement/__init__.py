"""What several families share of movement primitives: functions of tensors."""

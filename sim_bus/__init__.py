"""Simulated arm: a MuJoCo plant behind CANopen nodes that respond as drives do."""

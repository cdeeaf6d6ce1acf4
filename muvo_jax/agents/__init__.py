"""Agents in imagination: rewards, the environment core, its doors to other libraries, planners and an actor-critic.

Arrays in, arrays out: start states come as arrays, nothing here reads recordings or imports an RL library by itself.
"""

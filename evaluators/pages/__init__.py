"""What a person reads of a run: terminal, report, replay, why a rollout failed, gate, JUnit.

Pages read results and print them; they compute none.
"""

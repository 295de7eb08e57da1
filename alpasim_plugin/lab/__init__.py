"""The laboratory: training, the arms and claims of the paper, learned metrics, benches and studies."""

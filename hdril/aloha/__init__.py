"""An outside anchor: gym-aloha's two tasks, from state, with their scripted demonstrations. Needs the extra ``aloha``."""

"""How the shipped clips were made from DeepMimic's: retargeting, refinement and the recipe.

Nothing else imports this folder; clips and libraries are in `motion`.
"""

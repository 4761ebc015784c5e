"""Execution: a study's runs become rows of tables, in memory or in a results directory.

It takes a study, a record and options; prepares them once, divides the runs into tasks for this
process or Dask workers, and writes Parquet parts that a killed sweep continues. It gives `Results`,
whose rows depend on the study alone.
"""

"""Random spaces, infos and calls, here with ``SyncVectorEnv`` and in the sandbox: no difference."""

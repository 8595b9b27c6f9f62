-- The history of a task, `TaskHistory` of the API: points of its curves and previews. Replaced as a whole.
CREATE TABLE histories (
    job_id text COLLATE "C" NOT NULL,
    stage smallint NOT NULL,
    part bigint NOT NULL,
    history bytea NOT NULL,
    PRIMARY KEY (job_id, stage, part)
) WITH (fillfactor = 50);

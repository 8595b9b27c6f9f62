// Parts of the pages about a job. Each takes a container and later plain data:
//
//     const map = planMap(container, { onPhotograph });
//     map.update({ plan, cameras, tasks });
//     map.destroy();
//
// They need no framework and run under the policy in web/README.md. Their colours are CSS variables of
// parts.css, which a page may set to others.

export { type CompareData, compareViews } from './compare-views.ts';
export type { CurvePoint, CurveSeries, CurvesData } from './curve-points.ts';
export { curves } from './curves.ts';
export type { GetPicture, Part, TaskInfo } from './part.ts';
export type { ManifestContent, PlanContent, PlanPartition } from './plan-layout.ts';
export { type PlanMapData, type PlanMapOptions, planMap } from './plan-map.ts';
export type { TimelineData, TimelineEvent } from './timeline-bars.ts';
export { taskLabel } from './timeline-bars.ts';
export { timeline } from './timeline.ts';
export type { ComparedView } from './view-difference.ts';
export { type WaterData, waterPanel } from './water-panel.ts';
export type { PartitionWater, WaterContent } from './water-values.ts';

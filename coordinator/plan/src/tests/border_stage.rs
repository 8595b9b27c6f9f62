//! The training at borders after the merge.

use super::*;

#[test]
fn border_training_uses_training_views_that_may_show_it() {
    let (views, points) = (survey(203), floor(2000));
    let mut config = config(3, 2);
    assert_eq!(planned(&views, &points, &config).borders, None, "off is the default");
    config.borders.enabled = true;
    config.borders.width = 0.05;
    let plan = planned(&views, &points, &config);
    let stage = plan.borders.as_ref().unwrap();
    let cells: Vec<Rect> = plan.partitions.iter().map(|partition| partition.cell).collect();
    let expected: Vec<Segment> = seam_lines::borders(&cells).into_iter().map(Segment::from).collect();
    assert_eq!(stage.segments, expected);
    assert!((stage.width - 0.05 * plan.extent.viewing_distance.unwrap()).abs() < 1e-12);
    assert_eq!((stage.margin, stage.iterations), (stage.width, config.train.iterations * 3 / 10));
    let training = plan.training_views();
    assert!(stage.views.iter().all(|view| training.binary_search(view).is_ok()), "a held-out view");
    assert!(stage.views.is_sorted() && !stage.views.is_empty() && stage.views.len() < training.len());
    // A width of half of the scene makes all of it the band: every view with a point in it may show it.
    config.borders.width = 10.0;
    let wide = planned(&views, &points, &config).borders.unwrap();
    assert!(wide.views.len() > stage.views.len());
    assert!(wide.forecast.bytes > stage.forecast.bytes, "more is trained on more views");
    let (band, beyond) = (stage.band(), stage.surroundings());
    for (inner, outer) in band.iter().zip(&beyond) {
        assert!(outer.x.lo < inner.x.lo || inner.x.lo.is_none());
        assert!(outer.z.hi > inner.z.hi || inner.z.hi.is_none());
    }
    // Without points all views may show it; one partition has no borders.
    let blind = planned(&views, &Points::default(), &config).borders.unwrap();
    assert_eq!(blind.views, training);
    (config.partition.columns, config.partition.rows) = (1, 1);
    assert_eq!(planned(&views, &points, &config).borders, None);
}

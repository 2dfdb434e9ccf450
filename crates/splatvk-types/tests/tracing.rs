//! Events of `tracing`. A process of its own: a callsite that another test reaches first, on a
//! thread without a subscriber, would stay disabled.
#![allow(clippy::unwrap_used)] // helpers of tests
use splatvk_types::progress::{Progress, Recorded, Silent};
use std::sync::{Arc, Mutex};

/// Collects the fields of every event.
struct Collector(Mutex<Vec<String>>);

impl tracing::Subscriber for Collector {
    fn enabled(&self, metadata: &tracing::Metadata<'_>) -> bool {
        metadata.target() == "splatvk"
    }
    fn new_span(&self, _: &tracing::span::Attributes<'_>) -> tracing::span::Id {
        tracing::span::Id::from_u64(1)
    }
    fn record(&self, _: &tracing::span::Id, _: &tracing::span::Record<'_>) {}
    fn record_follows_from(&self, _: &tracing::span::Id, _: &tracing::span::Id) {}
    fn event(&self, event: &tracing::Event<'_>) {
        let mut text = event.metadata().level().to_string();
        event.record(&mut |field: &tracing::field::Field, value: &dyn std::fmt::Debug| {
            text += &format!(" {field}={value:?}");
        });
        self.0.lock().unwrap().push(text);
    }
    fn enter(&self, _: &tracing::span::Id) {}
    fn exit(&self, _: &tracing::span::Id) {}
}

#[test]
fn recorded_emits_events() {
    let collector = Arc::new(Collector(Mutex::default()));
    tracing::subscriber::with_default(collector.clone(), || {
        let recorded = Recorded::new(&Silent);
        recorded.begin("splats", 2);
        recorded.figures(1, &[("psnr", 20.0)]);
        recorded.warn("few matches");
        recorded.end();
    });
    let events = collector.0.lock().unwrap().clone();
    assert_eq!(events[0], r#"INFO message=begin stage="splats""#);
    assert_eq!(events[1], r#"DEBUG step=1 figures=[("psnr", 20.0)]"#);
    assert_eq!(events[2], "WARN message=few matches");
    assert!(events[3].starts_with(r#"INFO message=end stage="splats" seconds="#), "{events:?}");
}

//! Views of the finished scene from the photos' cameras, and answers to the queries.
use crate::Result;
use crate::fit::{Trained, TrainedLanguage};
use crate::pipeline::{Context, Lane, Output, Stage};
use crate::query::{QueryOptions, TextQuery};
use crate::run::answer::{Answers, Prepared};
use crate::run::view::{self, DecodedFrame};
use std::collections::HashMap;
use std::sync::Arc;

/// Renders and decodes every photo's view.
pub struct DecodeViews;

impl Stage for DecodeViews {
    const NAME: &'static str = "decode";
    const LANE: Lane = Lane::Device;
    type Inputs = (Output<Trained>, Output<TrainedLanguage>);
    type Output = Vec<DecodedFrame>;

    fn settings(&self) -> String {
        String::new()
    }

    fn run(
        self,
        (trained, language): (&Trained, &TrainedLanguage),
        context: &Context,
    ) -> Result<Vec<DecodedFrame>> {
        context.progress.begin("decode", trained.cameras.len() as u64);
        let frames = view::decode_all(context.device, &language.splats, &language.field, &trained.cameras);
        context.progress.end();
        frames
    }
}

/// Answers the queries.
pub struct AnswerQueries {
    /// Options of the answers.
    pub options: QueryOptions,
}

impl Stage for AnswerQueries {
    const NAME: &'static str = "query";
    const LANE: Lane = Lane::Device;
    type Inputs =
        (Output<Trained>, Output<Vec<DecodedFrame>>, Output<TrainedLanguage>, Output<Vec<TextQuery>>);
    type Output = Vec<Answers>;

    fn settings(&self) -> String {
        format!("{:?}", self.options)
    }

    fn run(
        self,
        (trained, frames, language, queries): (
            &Trained,
            &Vec<DecodedFrame>,
            &TrainedLanguage,
            &Vec<TextQuery>,
        ),
        context: &Context,
    ) -> Result<Vec<Answers>> {
        context.progress.begin("query", queries.len() as u64);
        let prepared = Prepared::of_frames(&language.splats, &language.field, frames);
        let mut backgrounds = HashMap::new();
        let mut answer = |query: &TextQuery| {
            for note in query.reading.notes() {
                // No warning: the scene is as good as ever, and the answer contains it.
                context.progress.inform(&format!("“{}”: {note}", query.text));
            }
            // Texts of one form share their alternatives.
            let background = backgrounds.entry(Arc::as_ptr(&query.alternatives.things)).or_insert(None);
            prepared.answer(
                &language.field,
                (&trained.cameras, frames),
                query,
                &self.options,
                background,
                None,
            )
        };
        let answers = queries.iter().map(&mut answer).collect();
        context.progress.end();
        answers
    }
}

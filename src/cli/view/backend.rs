//! Requests of a page that need its scene: questions, selections and edits.
use crate::cli::edit::entry;
use crate::cli::serve::{Answer, Asks, LiveSite};
use crate::format::edits::{Combine, Operation, Pick, Property, Rows, Term};
use crate::query::QueryOptions;
use crate::report::viewer::{self, Packed};
use crate::run::edit::expression::{self, terms};
use crate::run::edit::{Editor, Selected};
use crate::{Error, Result};
use serde::Deserialize;
use serde_json::{Value, json};
use std::time::Instant;

/// The scene behind a page.
pub struct Backend {
    editor: Editor,
    options: QueryOptions,
    /// Most splats of the page.
    budget: usize,
    /// Index of every splat of the page in the scene ([`Packed::order`]).
    order: Vec<usize>,
}

/// Body of a request of the page.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Body {
    /// Number of the page's scene ([`LiveSite::scene`]): bitmaps fit no other.
    scene: Option<u64>,
    request: Request,
}

/// Request of the page.
#[derive(Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
enum Request {
    /// Selects.
    Select(Vec<Part>),
    /// Adds an edit.
    Edit {
        operation: Operation,
        selection: Vec<Part>,
        /// Whether the user confirmed a doubtful selection.
        #[serde(default)]
        force: bool,
    },
    Undo {},
    Redo {},
    /// Lists the edits.
    List {},
    /// Distribution of a property.
    Histogram(Property),
}

/// Part of a selection: an expression, or a rule.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Part {
    #[serde(default)]
    combine: Combine,
    text: Option<String>,
    #[serde(default)]
    grow: f32,
    pick: Option<Pick>,
}

impl Backend {
    /// `order` is that of the page's splats.
    pub fn new(editor: Editor, options: QueryOptions, budget: usize, order: Vec<usize>) -> Backend {
        Backend { editor, options, budget, order }
    }

    /// Answers a request; an edit gives the site other splats.
    pub fn answer(&mut self, asks: &Asks, live: &LiveSite) -> Answer {
        let refused = |e: Error| (if (2..=3).contains(&e.exit_code()) { 422 } else { 500 }, e.to_string());
        let answer = match asks {
            Asks::Text(text) => self.query(text),
            Asks::Edit(body) => {
                let Body { scene, request } = serde_json::from_slice(body)
                    .map_err(|e| refused(Error::input(format!("this is no edit: {e}"))))?;
                if self.editor.reload().map_err(refused)? {
                    self.renew(live).map_err(refused)?;
                }
                if scene.is_some_and(|scene| scene != live.scene()) {
                    let notice = "The scene was edited elsewhere meanwhile; this is how it is now.";
                    return Err((409, notice.to_owned()));
                }
                self.edit(request, live)
            }
        };
        answer.map(|value| value.to_string()).map_err(refused)
    }

    fn query(&mut self, text: &str) -> Result<Value> {
        let clock = Instant::now();
        let answers = self.editor.ask(text, &self.options)?;
        let mut reply = answers.shown().json();
        reply["milliseconds"] = (1e3 * clock.elapsed().as_secs_f64()).into();
        Ok(reply)
    }

    fn edit(&mut self, request: Request, live: &LiveSite) -> Result<Value> {
        let mut along = 0;
        let changes = match request {
            Request::Select(parts) => return self.select(&parts),
            Request::Histogram(property) => {
                let histogram = self.editor.histogram(property)?;
                return Ok(json!({ "edges": histogram.edges, "counts": histogram.counts }));
            }
            Request::List {} => false,
            Request::Undo {} => self.editor.undo()?,
            Request::Redo {} => self.editor.redo()?,
            Request::Edit { operation, selection, force } => {
                let selected = self.selected(&selection)?;
                if let Some(doubt) = selected.doubts.first().filter(|_| !force) {
                    return Err(Error::input(format!("{doubt}; nothing is changed")));
                }
                along = self.editor.push(vec![(operation, selected)])?;
                true
            }
        };
        if changes {
            self.renew(live)?;
        }
        let list = self.editor.list();
        let lines = |edits: &[_]| edits.iter().map(entry).collect::<Vec<_>>();
        Ok(json!({
            "edits": lines(&list.edits), "undone": lines(&list.undone), "changed": changes, "along": along,
        }))
    }

    /// Gives the site the edited scene.
    fn renew(&mut self, live: &LiveSite) -> Result<()> {
        let scene = self.editor.scene();
        let Packed { bytes, order, .. } = viewer::pack(scene.into(), scene.language.as_ref(), self.budget)?;
        self.order = order;
        live.renew(bytes);
        Ok(())
    }

    fn selected(&mut self, parts: &[Part]) -> Result<Selected> {
        let mut all: Vec<Term> = Vec::new();
        for Part { combine, text, grow, pick } in parts {
            let mut own = match (text, pick) {
                (Some(text), None) => terms(text, self.editor.scene(), *grow)?,
                (None, Some(pick)) => vec![Term { combine: *combine, pick: pick.clone() }],
                _ => return Err(Error::input("a part of a selection has either a text or a rule")),
            };
            // The rest of an expression keeps its own signs.
            if let Some(first) = own.first_mut() {
                first.combine = *combine;
            }
            all.extend(own);
        }
        self.editor.select(&all)
    }

    /// Selected splats as a bitmap over those of the page.
    fn select(&mut self, parts: &[Part]) -> Result<Value> {
        let Selected { rows, count, share, doubts, terms } = self.selected(parts)?;
        let scene = self.editor.scene();
        let row = |i: usize| scene.edits.as_ref().map_or(i, |edits| edits.rows[i] as usize);
        let is_selected = |at: &usize| {
            let i = self.order[*at];
            i < scene.splats.len() && rows.has(row(i))
        };
        let bits = Rows::of((0..self.order.len()).filter(is_selected));
        Ok(json!({
            "count": count, "share": share, "doubts": doubts, "text": expression::texts(&terms), "bits": bits,
        }))
    }
}

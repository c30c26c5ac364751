//! Report: the rows of a run, and the truth if there is one, in; one self-contained HTML page out.
//!
//! | module | makes |
//! |---|---|
//! | `run` | of rows and truth, what several figures need |
//! | `facts` | the headline: a sentence and numbers |
//! | `map`, `figures`, `against_truth`, `budget` | the figures |
//! | `plot`, `scale`, `svg` | panels, axes, elements |
//! | `page` | the page around them |
//!
//! The page needs no network and no script; a script that it carries adds zoom and pan.

mod against_truth;
mod budget;
mod facts;
pub(crate) mod figures;
mod map;
pub(crate) mod page;
pub(crate) mod plot;
mod run;
pub(crate) mod scale;
pub(crate) mod svg;
#[cfg(test)]
mod tests;

use super::row::OdometryRow;
use crate::evaluation::{AssociationError, Settings, Trajectory};

/// Why there is no report.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ReportError {
    /// Nothing to report on.
    #[error("there is no odometry row to report on")]
    NoRows,
    /// The truth is of something else.
    #[error(transparent)]
    Association(#[from] AssociationError),
}

/// The page for a run, as HTML.
///
/// With `truth`, errors and the consistency of covariances are shown too; `settings` say how it is
/// associated. Lengths of segments that the path is too short for are replaced by shorter ones.
///
/// # Errors
/// [`ReportError`].
pub fn render(
    rows: &[OdometryRow],
    truth: Option<&Trajectory>,
    settings: &Settings,
    title: &str,
) -> Result<String, ReportError> {
    if rows.is_empty() {
        return Err(ReportError::NoRows);
    }
    let run = run::Run::new(rows, truth, settings)?;
    let mut figures = vec![map::from_above(&run)];
    figures.extend(figures::all(&run));
    Ok(page::page(title, &run, &figures))
}

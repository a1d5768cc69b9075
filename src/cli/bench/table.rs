//! A table of figures, measured or modeled: printed, and written as JSON, CSV and SVG.

use std::path::Path;

use serde_json::{Map, Value, json};

use crate::cli::{CliError, answer};
use crate::output::plot::{Series, line_chart};
use crate::output::{Machine, write_atomically};

/// Column heads and rows of numbers.
pub(super) struct FigureTable {
    name: String,
    title: String,
    kind: &'static str,
    y_label: &'static str,
    columns: Vec<&'static str>,
    rows: Vec<Vec<f64>>,
    /// Head of a first column of names, and the name of every row.
    names: Option<(&'static str, Vec<String>)>,
}

impl FigureTable {
    /// An empty table of measured figures; `name` names its files.
    pub(super) fn new(name: impl Into<String>, title: String, columns: Vec<&'static str>) -> FigureTable {
        let kind = "measured";
        FigureTable { name: name.into(), title, kind, y_label: "speed-up", columns, rows: Vec::new(), names: None }
    }

    /// The same for figures that were modeled.
    pub(super) fn modeled(name: impl Into<String>, title: String, columns: Vec<&'static str>) -> FigureTable {
        FigureTable { kind: "modelled", ..FigureTable::new(name, title, columns) }
    }

    /// The same for columns of both kinds, each of which says in its name which it is.
    pub(super) fn mixed(name: impl Into<String>, title: String, columns: Vec<&'static str>) -> FigureTable {
        FigureTable { kind: "measured and modelled", ..FigureTable::new(name, title, columns) }
    }

    /// The table with another label of the y axis, for pictures of several curves.
    pub(super) fn y_label(self, y_label: &'static str) -> FigureTable {
        FigureTable { y_label, ..self }
    }

    /// The table under another name of its files.
    pub(super) fn named(self, name: impl Into<String>) -> FigureTable {
        FigureTable { name: name.into(), ..self }
    }

    /// Name of its files.
    pub(super) fn name(&self) -> &str {
        &self.name
    }

    /// Head of the first column.
    pub(super) fn first_column(&self) -> &'static str {
        self.columns.first().copied().unwrap_or("")
    }

    /// The table with a name for every row, in a first column with this head.
    pub(super) fn with_names(self, head: &'static str) -> FigureTable {
        FigureTable { names: Some((head, Vec::new())), ..self }
    }

    /// Adds a row of a table with names.
    pub(super) fn push_named(&mut self, name: &str, row: Vec<f64>) {
        if let Some((_, names)) = &mut self.names {
            names.push(name.to_owned());
        }
        self.push(row);
    }

    /// Adds a row, one number per column.
    pub(super) fn push(&mut self, row: Vec<f64>) {
        assert_eq!(row.len(), self.columns.len());
        self.rows.push(row);
    }

    /// Prints the table. A closed pipe is not an error.
    pub(super) fn print(&self) -> Result<(), CliError> {
        let cell = |v: f64| match v {
            v if v.is_nan() => "-".to_string(),
            v if v.fract() == 0.0 && v.abs() < 1e15 => format!("{v:.0}"),
            v if v.abs() >= 100.0 => format!("{v:.1}"),
            v => format!("{v:.4}"),
        };
        let mut heads = self.columns.clone();
        let mut cells: Vec<Vec<String>> = self.rows.iter().map(|row| row.iter().map(|&v| cell(v)).collect()).collect();
        if let Some((head, names)) = &self.names {
            heads.insert(0, head);
            cells.iter_mut().zip(names).for_each(|(row, name)| row.insert(0, name.clone()));
        }
        let widths: Vec<usize> = heads
            .iter()
            .enumerate()
            .map(|(i, head)| cells.iter().map(|row| row[i].len()).max().unwrap_or(0).max(head.len()))
            .collect();
        let mut text = format!("{}\n", self.title);
        let line = |cells: Vec<&str>| {
            cells.iter().zip(&widths).map(|(cell, &width)| format!("{cell:>width$}")).collect::<Vec<_>>().join("  ")
        };
        text += &line(heads);
        for row in &cells {
            text.push('\n');
            text += &line(row.iter().map(String::as_str).collect());
        }
        text.push('\n');
        answer(&text, || self.document())
    }

    /// The table as JSON.
    pub(super) fn document(&self) -> Value {
        let row = |(i, row): (usize, &Vec<f64>)| -> Value {
            let name = self.names.iter().map(|(head, names)| (head.to_string(), json!(names[i])));
            let cells = self.columns.iter().zip(row).map(|(head, &v)| (head.to_string(), json!(v)));
            Value::Object(name.chain(cells).collect::<Map<_, _>>())
        };
        let machine = Machine::here();
        json!({
            "benchmark": self.name,
            "title": self.title,
            "kind": self.kind,
            "command": std::env::args().collect::<Vec<_>>().join(" "),
            "machine": {"cpu": machine.cpu, "cores": machine.cores},
            "rows": self.rows.iter().enumerate().map(row).collect::<Vec<_>>(),
        })
    }

    /// The table as comma-separated values with a line of heads; empty where there is no number.
    fn csv(&self) -> String {
        let heads = self.names.iter().map(|(head, _)| *head).chain(self.columns.iter().copied());
        let mut text = heads.collect::<Vec<_>>().join(",") + "\n";
        for (i, row) in self.rows.iter().enumerate() {
            let name = self.names.iter().map(|(_, names)| names[i].clone());
            let cell = |v: &f64| if v.is_nan() { String::new() } else { v.to_string() };
            text += &name.chain(row.iter().map(cell)).collect::<Vec<_>>().join(",");
            text.push('\n');
        }
        text
    }

    /// Writes `name.json` and `name.csv`, and `name.svg` with the columns of `curves` over its first one if there are
    /// at least two rows.
    pub(super) fn write(&self, folder: &Path, curves: Option<(&str, &[&str])>) -> Result<(), CliError> {
        std::fs::create_dir_all(folder)
            .map_err(|error| CliError::bad_input(format!("cannot write to {}: {error}", folder.display())))?;
        let text = serde_json::to_string_pretty(&self.document()).map_err(CliError::failed)?;
        write_atomically(&folder.join(format!("{}.json", self.name)), |out| out.write_all(text.as_bytes()))
            .map_err(CliError::failed)?;
        write_atomically(&folder.join(format!("{}.csv", self.name)), |out| out.write_all(self.csv().as_bytes()))
            .map_err(CliError::failed)?;
        let column = |name: &str| self.columns.iter().position(|head| *head == name);
        let Some((x, names)) = curves.filter(|_| self.rows.len() > 1) else { return Ok(()) };
        let Some(i) = column(x) else { return Ok(()) };
        let points = |j: usize| self.rows.iter().map(|row| (row[i], row[j])).collect::<Vec<_>>();
        let series: Vec<Series> = names
            .iter()
            .filter_map(|name| Some(Series { name: name.to_string(), points: points(column(name)?) }))
            .filter(|series| series.points.iter().any(|(_, y)| y.is_finite()))
            .collect();
        let label = if let [only] = names { only } else { self.y_label };
        if !series.is_empty() {
            let path = folder.join(format!("{}.svg", self.name));
            line_chart(&path, &self.title, x, label, &series).map_err(CliError::failed)?;
        }
        Ok(())
    }

    /// Prints, and writes if `folder` is given.
    pub(super) fn finish(&self, folder: Option<&Path>, curve: Option<(&str, &str)>) -> Result<(), CliError> {
        let names = curve.map(|(_, y)| [y]);
        self.finish_curves(folder, curve.zip(names.as_ref()).map(|((x, _), names)| (x, &names[..])))
    }

    /// As [`FigureTable::finish`], with several curves in one picture.
    pub(super) fn finish_curves(&self, folder: Option<&Path>, curves: Option<(&str, &[&str])>) -> Result<(), CliError> {
        self.print()?;
        folder.map_or(Ok(()), |folder| self.write(folder, curves))
    }
}

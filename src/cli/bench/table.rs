//! A table of figures, measured or modelled: printed, and written as JSON and SVG.

use std::io::Write;
use std::path::Path;

use serde_json::{Map, Value, json};

use crate::cli::CliError;
use crate::output::plot::{Series, line_chart};
use crate::output::{Machine, write_atomically};

/// Column heads and rows of numbers.
pub struct Table {
    name: String,
    title: String,
    kind: &'static str,
    columns: Vec<&'static str>,
    rows: Vec<Vec<f64>>,
}

impl Table {
    /// An empty table of measured figures; `name` names its files.
    pub fn new(name: impl Into<String>, title: String, columns: Vec<&'static str>) -> Table {
        Table { name: name.into(), title, kind: "measured", columns, rows: Vec::new() }
    }

    /// The same for figures that were modelled.
    pub fn modelled(name: impl Into<String>, title: String, columns: Vec<&'static str>) -> Table {
        Table { kind: "modelled", ..Table::new(name, title, columns) }
    }

    /// Adds a row.
    pub fn push(&mut self, row: Vec<f64>) {
        assert_eq!(row.len(), self.columns.len());
        self.rows.push(row);
    }

    /// Prints the table; a reader that went away is no error.
    pub fn print(&self) -> Result<(), CliError> {
        let cell = |v: f64| match v {
            v if v.is_nan() => "-".to_string(),
            v if v.fract() == 0.0 && v.abs() < 1e15 => format!("{v:.0}"),
            v if v.abs() >= 100.0 => format!("{v:.1}"),
            v => format!("{v:.4}"),
        };
        let cells: Vec<Vec<String>> = self.rows.iter().map(|row| row.iter().map(|&v| cell(v)).collect()).collect();
        let widths: Vec<usize> = self
            .columns
            .iter()
            .enumerate()
            .map(|(i, head)| cells.iter().map(|row| row[i].len()).max().unwrap_or(0).max(head.len()))
            .collect();
        let mut text = format!("{}\n", self.title);
        let line = |cells: Vec<&str>| {
            cells.iter().zip(&widths).map(|(cell, &width)| format!("{cell:>width$}")).collect::<Vec<_>>().join("  ")
        };
        text += &line(self.columns.clone());
        for row in &cells {
            text.push('\n');
            text += &line(row.iter().map(String::as_str).collect());
        }
        text.push('\n');
        match std::io::stdout().write_all(text.as_bytes()) {
            Err(error) if error.kind() != std::io::ErrorKind::BrokenPipe => {
                Err(CliError::failed(format!("cannot print the table: {error}")))
            }
            _ => Ok(()),
        }
    }

    /// Writes `name.json`, and `name.svg` with column `y` over column `x` if there are at least two rows.
    pub fn write(&self, folder: &Path, curve: Option<(&str, &str)>) -> Result<(), CliError> {
        std::fs::create_dir_all(folder)
            .map_err(|error| CliError::bad_input(format!("cannot write to {}: {error}", folder.display())))?;
        let rows: Vec<Value> = self
            .rows
            .iter()
            .map(|row| {
                Value::Object(
                    self.columns.iter().zip(row).map(|(head, &v)| (head.to_string(), json!(v))).collect::<Map<_, _>>(),
                )
            })
            .collect();
        let machine = Machine::here();
        let document = json!({"benchmark": self.name, "title": self.title, "kind": self.kind, "command": std::env::args().collect::<Vec<_>>().join(" "),
            "machine": {"cpu": machine.cpu, "cores": machine.cores}, "rows": rows});
        let text = serde_json::to_string_pretty(&document).map_err(CliError::failed)?;
        write_atomically(&folder.join(format!("{}.json", self.name)), |out| out.write_all(text.as_bytes()))
            .map_err(CliError::failed)?;
        let column = |name: &str| self.columns.iter().position(|head| *head == name);
        if let Some((x, y)) = curve
            && let (Some(i), Some(j)) = (column(x), column(y))
            && self.rows.len() > 1
        {
            let points = self.rows.iter().map(|row| (row[i], row[j])).collect();
            let series = [Series { name: y.to_string(), points }];
            line_chart(&folder.join(format!("{}.svg", self.name)), &self.title, x, y, &series)
                .map_err(CliError::failed)?;
        }
        Ok(())
    }

    /// Prints, and writes if `folder` is given.
    pub fn finish(&self, folder: Option<&Path>, curve: Option<(&str, &str)>) -> Result<(), CliError> {
        self.print()?;
        folder.map_or(Ok(()), |folder| self.write(folder, curve))
    }
}

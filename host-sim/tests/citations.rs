//! Everything that code and documents cite exists: `docs/PAGE.md section N` names a numbered heading of an
//! existing page, and relative links in Markdown have a target. A page is that of the citing file's own
//! package, or else its path is from the root.

use std::collections::BTreeMap;
use std::fs;

use recipe_test_kit::source::root;

/// Pages by their path from the root, each with the numbers of its sections.
type Pages = BTreeMap<String, Vec<String>>;

#[test]
fn every_cited_section_exists() {
    let files = files();
    let pages = pages(&files);
    let mut wrong = Vec::new();
    let mut seen = 0;
    for (name, text) in &files {
        for citation in citations(&unwrapped(text)) {
            seen += 1;
            let own = name.split_once('/').map(|(package, _)| format!("{package}/{}", citation.page));
            let own = own.and_then(|page| pages.get(&page));
            let Some(sections) = own.or_else(|| pages.get(&citation.page)) else {
                wrong.push(format!("{name}: there is no {}", citation.page));
                continue;
            };
            for section in citation.sections.iter().filter(|section| !sections.contains(section)) {
                wrong.push(format!("{name}: {} has no section {section}", citation.page));
            }
        }
    }
    assert!(seen > 50, "only {seen} citations found: the search is broken");
    assert!(wrong.is_empty(), "\n{}\n", wrong.join("\n"));
}

#[test]
fn every_link_between_documents_leads_somewhere() {
    let mut wrong = Vec::new();
    for (name, text) in files().iter().filter(|(name, _)| name.ends_with(".md")) {
        let folder = root().join(name).parent().unwrap().to_path_buf();
        for target in text.split("](").skip(1).filter_map(|rest| rest.split(')').next()) {
            let path = target.split('#').next().unwrap();
            let elsewhere = target.contains("://") || target.starts_with('#') || target.contains(' ');
            if !elsewhere && !folder.join(path).exists() {
                wrong.push(format!("{name}: {target}"));
            }
        }
    }
    assert!(wrong.is_empty(), "\n{}\n", wrong.join("\n"));
}

#[test]
fn citations_are_read_however_they_are_written() {
    let cited = |text: &str| citations(&unwrapped(text));
    let expect = |page: &str, sections: &[&str]| Citation {
        page: format!("docs/{page}.md"),
        sections: sections.iter().map(|&section| section.to_owned()).collect(),
    };
    assert_eq!(cited("see docs/a.md."), [expect("a", &[])]);
    assert_eq!(cited("docs/a.md section 3, and more"), [expect("a", &["3"])]);
    assert_eq!(cited("(docs/a.md sections 2 to 4)."), [expect("a", &["2", "3", "4"])]);
    assert_eq!(cited("docs/a.md sections 2, 3 and 7"), [expect("a", &["2", "3", "7"])]);
    assert_eq!(cited("//! as docs/wire/a.md\n//! section 5 says"), [expect("wire/a", &["5"])]);
    assert_eq!(cited("docs/a.md, docs/b.md section 1"), [expect("a", &[]), expect("b", &["1"])]);
    assert_eq!(cited("[docs/a.md section 1][a]."), [expect("a", &["1"])]);
    let of_package = Citation { page: "proto-core/docs/a.md".to_owned(), sections: vec!["2".to_owned()] };
    assert_eq!(cited("(proto-core/docs/a.md section 2)"), [of_package]);
    assert_eq!(cited("docs/wire/*.md, docs/wire/NAME.md"), []);
}

/// Packages whose pages are cited elsewhere.
const PACKAGES_WITH_PAGES: [&str; 1] = ["proto-core/"];

#[derive(Debug, PartialEq)]
struct Citation {
    page: String,
    sections: Vec<String>,
}

fn citations(text: &str) -> Vec<Citation> {
    let package = |at: usize| PACKAGES_WITH_PAGES.iter().find(|package| text[..at].ends_with(*package));
    let starts =
        text.match_indices("docs/").map(|(at, _)| at - package(at).map_or(0, |package| package.len()));
    starts.filter_map(|at| text.get(at..)).filter_map(citation).collect()
}

/// The citation at the start of `text`; placeholders such as `docs/wire/NAME.md` are none.
fn citation(text: &str) -> Option<Citation> {
    let end = text.find(".md")? + ".md".len();
    let page = &text[..end];
    let is_page = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || "/_-.".contains(c);
    if !page.replace("README", "").chars().all(is_page) {
        return None;
    }
    let rest = text[end..].strip_prefix(" section").map(|rest| rest.strip_prefix('s').unwrap_or(rest));
    let mut sections: Vec<String> = Vec::new();
    let mut range = false;
    for word in rest.unwrap_or("").split_whitespace() {
        let number = word.trim_end_matches(|c: char| !c.is_ascii_digit());
        match word.trim_end_matches(',') {
            "to" if !sections.is_empty() => range = true,
            "and" if !sections.is_empty() => {}
            _ if number.starts_with(|c: char| c.is_ascii_digit()) => {
                let from = sections.last().filter(|_| range).and_then(|from| from.parse::<u32>().ok());
                match (from, number.parse::<u32>()) {
                    (Some(from), Ok(to)) => sections.extend((from + 1..=to).map(|n| n.to_string())),
                    _ => sections.push(number.to_owned()),
                }
                range = false;
                if !matches!(&word[number.len()..], "" | ",") {
                    break;
                }
            }
            _ => break,
        }
    }
    Some(Citation { page: page.to_owned(), sections })
}

/// The text as one line, without the marks of comments.
fn unwrapped(text: &str) -> String {
    let lines = text.lines().map(|line| line.trim_start().trim_start_matches(['/', '!', '#', '*']));
    lines.flat_map(str::split_whitespace).collect::<Vec<_>>().join(" ")
}

fn pages(files: &[(String, String)]) -> Pages {
    let headings = |text: &str| {
        let headings = text
            .lines()
            .filter_map(|line| line.strip_prefix("##")?.trim_matches('#').split_whitespace().next());
        headings.map(|word| word.trim_end_matches('.').to_owned()).collect()
    };
    files.iter().map(|(name, text)| (name.clone(), headings(text))).collect()
}

/// Every source, document and script with its path from the root.
fn files() -> Vec<(String, String)> {
    let mut files = Vec::new();
    let mut folders = vec![root()];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(&folder).unwrap() {
            let path = entry.unwrap().path();
            let name = path.file_name().unwrap().to_string_lossy().into_owned();
            if path.is_dir() {
                if !["target", ".git", "run", "__pycache__", "node_modules"].contains(&name.as_str()) {
                    folders.push(path);
                }
            } else if ["rs", "md", "toml", "py", "sh"].iter().any(|end| name.ends_with(&format!(".{end}"))) {
                let from_root = path.strip_prefix(root()).unwrap().to_string_lossy().into_owned();
                files.push((from_root, fs::read_to_string(&path).unwrap()));
            }
        }
    }
    // The examples in this file are no citations.
    files.retain(|(name, _)| !name.ends_with("tests/citations.rs"));
    files.sort();
    files
}

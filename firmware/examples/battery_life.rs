//! Prints how long batteries last, as `docs/bluetooth.md` shows it.

use vergence_firmware::power::{Cell, Currents, Use, budget, life_days};

fn main() {
    let currents = Currents::default();
    let cells = [("CR2032", Cell::CR2032), ("CR2477", Cell::CR2477), ("2 x AAA", Cell::TWO_AAA)];
    let default = Use::default();
    let uses = [
        ("default: 10 finds a day", default),
        ("idle: never found", Use { finds: 0.0, ..default }),
        ("one find a day", Use { finds: 1.0, ..default }),
        ("100 finds a day", Use { finds: 100.0, ..default }),
        ("advertising every 2 s", Use { slow_interval: 2.0, ..default }),
        ("light full on", Use { brightness: 1.0, ..default }),
        (
            "advertising every 2 s, light 20 %",
            Use { slow_interval: 2.0, brightness: 0.2, ..default },
        ),
    ];
    println!(
        "| use | mC a day: sleep, advertising, wakes, links, light | {} |",
        cells.map(|(name, _)| format!("{name} (days)")).join(" | ")
    );
    println!("|---|---|---|---|---|");
    for (name, usage) in uses {
        let b = budget(&currents, &usage);
        let parts = [b.sleep, b.advertising, b.wakes, b.links, b.light];
        let parts = parts.map(|c| format!("{:.0}", c * 1e3)).join(", ");
        let days = cells.map(|(_, cell)| format!("{:.0}", life_days(&cell, &currents, &usage)));
        println!("| {name} | {parts} | {} |", days.join(" | "));
    }
}
